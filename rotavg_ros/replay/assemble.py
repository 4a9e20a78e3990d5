"""Assembles the record of a finished replay: poses by robot, references, topics."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.bags.reader import BagReader
from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.files.pose_files import read_pose_file
from rotavg_ros.online import Answer, OnlineEstimator
from rotavg_ros.online.answer.trajectory import Trajectory
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS
from rotavg_ros.replay.feed import Feed, read_references
from rotavg_ros.replay.frames import BagFrames
from rotavg_ros.replay.mounting import without_mounting
from rotavg_ros.replay.plan import Input, Plan
from rotavg_ros.replay.record import Reference, RobotRecord, RunRecord, positions_told
from rotavg_ros.replay.run import Outcome, Window, bounds

_IMU = "sensor_msgs/msg/Imu"


def assemble(bag: BagReader, plan: Plan, outcome: Outcome) -> RunRecord:
    """The record of a replay; a file that no longer fits, as after Ctrl-C, is left out with a warning."""
    answer = outcome.answer
    trajectories = outcome.estimator.trajectories(answer)
    references, misfits = _references(bag, plan, outcome, trajectories)
    return RunRecord(
        name=Path(os.path.abspath(bag.path)).stem,  # `.` has none
        duration_s=(outcome.end_ns - outcome.start_ns) / 1e9,
        answer=answer,
        robots=tuple(
            _robot(answer, robot, trajectory, references.get(robot)) for robot, trajectory in trajectories.items()
        ),
        ticks=outcome.ticks,
        topics=plan.topics,
        rejected=outcome.estimator.counts().rejected,
        options=plan.parameters.values(),
        wall_seconds=outcome.wall_seconds,
        interrupted=outcome.interrupted or outcome.damage is not None,
        warnings=(*outcome.warnings, *misfits),
        damage=None if outcome.damage is None else outcome.damage.removeprefix(f"{bag.path}: "),
    )


def check_references(bag: BagReader, plan: Plan, window: Window) -> None:
    """Refuse files that do not belong to the bag, before its replay: its messages are taken without solving anything.

    Raises:
        GraphFileError: a file that cannot be read, stamps of another time, or a number of rows that fits nothing.
        ReplayError: the window begins after the end.
    """
    files = {robot: source for robot, source in plan.references.items() if isinstance(source, Path)}
    if not files:
        return
    estimator, odometry_ns = OnlineEstimator(plan.parameters.estimator), dict[str, list[int]]()
    feed = Feed(
        estimator,
        plan,
        BagFrames(bag, plan),
        lambda robot, record: odometry_ns.setdefault(robot, []).append(record.stamp_ns),
    )
    for topic, _, message in bag.decoded(feed.topics, *bounds(bag, window)):
        feed(topic, message)
    graph = estimator.snapshot()
    for robot, path in files.items():
        of_robot = graph.keyframe_robot == (graph.robots.index(robot) if robot in graph.robots else -1)
        keyframes_ns = graph.stamp_ns[of_robot & (graph.stamp_ns != UNKNOWN_STAMP_NS)]
        if len(keyframes_ns):
            _from_file(path, keyframes_ns, np.array(odometry_ns.get(robot, []), dtype=np.int64))


def _robot(answer: Answer, robot: str, trajectory: Trajectory, reference: Reference | None) -> RobotRecord:
    return RobotRecord(
        robot=robot,
        nodes=trajectory.node,
        stamp_ns=trajectory.stamp_ns,
        time_line=trajectory.time_line,
        keyframe_id=answer.keyframe_id[trajectory.node],
        odometry_world_from_body=trajectory.odometry_world_from_body,
        odometry_position=_known(trajectory.odometry_position),
        world_from_body=trajectory.world_from_body,
        position_dead_reckoned=_known(trajectory.position_dead_reckoned),
        position=_known(trajectory.position),
        uncertainty=answer.uncertainty[trajectory.node],
        reference=reference,
    )


def _known(position: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return position if np.isfinite(position).any() else None


def _references(
    bag: BagReader, plan: Plan, outcome: Outcome, trajectories: Mapping[str, Trajectory]
) -> tuple[dict[str, Reference], list[str]]:
    """References by robot, and a line for each file that does not fit."""
    inputs = {robot: source for robot, source in plan.references.items() if isinstance(source, Input)}
    references = read_references(bag, inputs, plan.parameters, outcome.start_ns, outcome.end_ns + 1)
    for robot, topic in inputs.items():
        if topic.type_name == _IMU and robot in references and robot in trajectories:
            trajectory = trajectories[robot]
            last = trajectory.time_line == trajectory.time_line.max()
            orientation = trajectory.odometry_world_from_body[last]
            references[robot] = without_mounting(references[robot], trajectory.stamp_ns[last], orientation)
    misfits = []
    for robot, source in plan.references.items():
        if isinstance(source, Path) and robot in trajectories:
            odometry_ns = outcome.odometry_stamps_ns.get(robot, np.empty(0, dtype=np.int64))
            try:
                references[robot] = _from_file(source, trajectories[robot].stamp_ns, odometry_ns)
            except GraphFileError as error:
                misfits.append(f"not compared with the reference {error}")
    return references, misfits


def _from_file(path: Path, keyframes_ns: NDArray[np.int64], odometry_ns: NDArray[np.int64]) -> Reference:
    """A file's poses; those without stamps belong one by one to the odometry's messages or to the keyframes.

    Raises:
        GraphFileError: stamps of another time, or a number of rows that matches neither.
    """
    poses = read_pose_file(path)
    rows = len(poses.position)
    time_line = None
    if poses.stamps_ns is None:
        stamps_ns = next((stamps for stamps in (odometry_ns, keyframes_ns) if len(stamps) == rows), None)
        if stamps_ns is None:
            what = (
                f"{rows} poses without stamps, but {len(odometry_ns)} odometry messages and {len(keyframes_ns)} "
                "keyframes in what is replayed; give a file with stamps (TUM), or replay the whole bag"
            )
            raise GraphFileError.at(path, None, what)
        if (np.diff(stamps_ns) <= 0).any():
            time_line = np.cumsum(np.diff(stamps_ns, prepend=stamps_ns[0] - 1) <= 0, dtype=np.int64)
    else:
        stamps_ns = poses.stamps_ns
        first_ns, last_ns = keyframes_ns.min(), keyframes_ns.max()
        if stamps_ns[0] > last_ns or stamps_ns[-1] < first_ns:
            what = (
                f"its stamps ({stamps_ns[0] / 1e9:.1f} … {stamps_ns[-1] / 1e9:.1f} s) do not overlap the bag's "
                f"({first_ns / 1e9:.1f} … {last_ns / 1e9:.1f} s)"
            )
            raise GraphFileError.at(path, None, what)
    return Reference(path.name, stamps_ns, poses.world_from_body, positions_told(poses.position), time_line)
