"""A real robot's graph, converted to a bag and played to the live node faster than real time."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rotavg_msgs.msg import AbsoluteOrientations

BIN = Path(sys.executable).parent
RELIABLE_ODOMETRY = "qos_overrides./odom.subscription.reliability:=reliable"


def rotavg(*arguments: str | Path) -> str:
    done = subprocess.run([BIN / "rotavg", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.ros
@pytest.mark.large
@pytest.mark.parametrize(("threshold", "num_edges"), [("0.500", 8479), ("0.000", 8803)])
def test_b25b_live_agrees_with_ground_truth_and_with_the_offline_solve(
    threshold: str,
    num_edges: int,
    shared_data: Path,
    tmp_path: Path,
    start_process: Callable,
    probe_node,
    wait_until: Callable,
) -> None:
    graph = shared_data / "slam" / "b25b" / f"B25b_{threshold}.g2o"
    truth = graph.with_name("ground_truth.csv")
    bag = tmp_path / "bag"
    rotavg("convert", graph, bag, "--stamps", graph.with_name("B25b_timestamps.txt"), "--truth", truth)
    rotavg("solve", graph, "--output", tmp_path / "offline")

    answers: list[AbsoluteOrientations] = []
    status: dict[str, str] = {}
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    probe_node.create_subscription(AbsoluteOrientations, "/abs_orientations", answers.append, latched)
    probe_node.create_subscription(
        DiagnosticArray,
        "/diagnostics",
        lambda message: status.update({pair.key: pair.value for pair in message.status[0].values}),
        10,
    )
    executor = SingleThreadedExecutor(context=probe_node.context)
    executor.add_node(probe_node)

    def spin_until(condition: Callable[[], bool], node) -> None:
        def met() -> bool:
            executor.spin_once(timeout_sec=0.05)
            return condition()

        wait_until(met, node, timeout=300.0)

    node = start_process(BIN / "rotavg_node", "--ros-args", "-p", "keyframe_source:=edges", "-p", RELIABLE_ODOMETRY)
    spin_until(lambda: bool(status), node)
    # 600 messages a second: as fast as can be, a busy machine loses some however reliable the connection is.
    player = start_process(BIN / "rotavg", "play", bag, "--rate", "60")
    spin_until(lambda: not player.is_running, node)
    assert player.wait() == 0, player.output
    # Everything has come when nothing waits any more and a cold answer covers all keyframes.
    spin_until(lambda: status["answer cold"] == "true" and status["keyframes"] == "8358", node)
    spin_until(lambda: len(answers[-1].keyframe_ids) == 8358 and float(status["answer age s"]) > 2, node)

    assert {key: status[key] for key in ("lost messages", "missed before first", "pending", "dropped")} == {
        "lost messages": "0",
        "missed before first": "0",
        "pending": "0",
        "dropped": "0",
    }
    assert (status["edges"], status["edge messages"], status["odometry messages"]) == (
        f"{num_edges}",
        f"{num_edges}",
        "8358",
    )
    answer = answers[-1]
    by_id = np.argsort(answer.keyframe_ids)
    ours = Rotation.from_quat(np.array(answer.orientations).reshape(-1, 4)[by_id])
    with (tmp_path / "offline" / "orientations.csv").open() as file:
        offline = Rotation.from_quat([[float(row[f"q{axis}"]) for axis in "xyzw"] for row in csv.DictReader(file)])
    assert np.degrees(in_gauge_of_first(ours, offline).max()) < 0.01

    stamps = np.array(answer.stamps_ns)[by_id] / 1e9
    known = np.loadtxt(truth, delimiter=",")
    nearest = np.abs(known[:, 0] - stamps[:, None]).argmin(axis=1)
    matched = np.abs(known[nearest, 0] - stamps) < 0.15
    headings = Rotation.from_euler("z", known[nearest[matched], 3][:, None])
    world_from_truth = (ours[matched] * headings.inv()).mean()
    errors = (ours[matched].inv() * world_from_truth * headings).magnitude()
    assert matched.sum() > 7000
    assert np.degrees(errors.mean()) < 2.5


def in_gauge_of_first(a: Rotation, b: Rotation) -> np.ndarray:
    """Angles between two sets of orientations after turning both worlds to the first one."""
    return ((a[0].inv() * a).inv() * (b[0].inv() * b)).magnitude()
