"""Online in Python, without ROS: odometry and loop closures in, corrected orientations and edge scores out.

    python examples/online_in_python.py

A robot drives five laps by odometry that takes every turn for 1 % wider than it is. From the second lap on it
recognises where it was a lap ago, every fourth time wrongly.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeMeasurement, KeyframeReference, OnlineEstimator

LAP, LAPS, PERIOD_NS = 60, 5, 100_000_000
heading = np.outer(np.arange(LAPS * LAP), [0, 0, 2 * np.pi / LAP])
true, odometry = Rotation.from_rotvec(heading), Rotation.from_rotvec(1.01 * heading)  # world_from_body
rng = np.random.default_rng(0)

estimator = OnlineEstimator()
for now in range(LAPS * LAP):
    estimator.add_odometry("robot", now * PERIOD_NS, odometry[now].as_quat())
    if now >= LAP and now % 5 == 0:
        seen = true[now - LAP].inv() * true[now]  # the target's orientation in the source's frame, as ROS states it
        if now % 20 == 0:
            seen *= Rotation.from_rotvec([0, 0, rng.uniform(1, 3)])  # false
        source, target = (KeyframeReference("robot", stamp_ns=pose * PERIOD_NS) for pose in (now - LAP, now))
        estimator.add_edge(EdgeMeasurement.from_ros(now, source, target, seen.as_quat()))
    if now % 10 == 0:
        estimator.tick()  # answers what is new; the robot's corrected orientation is then
        latest = estimator.current_orientation("robot")  # xyzw, world_from_body, up to the last odometry
        estimator.go_on()  # with what takes longer than a tick may; the next one goes by it

answer = estimator.tick(force_cold=True)  # all of it once more: what `rotavg solve` says of the same graph
corrected, pose = Rotation.from_quat(answer.world_from_body), answer.stamp_ns // PERIOD_NS
for name, found in (("odometry", odometry[pose]), ("corrected", corrected)):
    print(f"{name}: {np.degrees((found * true[pose].inv()).magnitude().mean()):.1f}° off in the mean")
print("false closures:", *answer.edge_id[answer.outlier])  # those whose answer.outlier_score is above one half
