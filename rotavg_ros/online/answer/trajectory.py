"""Positions along corrected orientations: from odometry's steps alone, and with closures that carry translations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS
from rotavg_ros.online.odometry.samples import OdometrySamples
from rotavg_ros.view_graph import EdgeKind


@dataclass(frozen=True)
class Trajectory:
    """A robot's keyframes in order of time (K of them).

    Attributes:
        node: ``(K,)`` indices into the answer's keyframes.
        stamp_ns, time_line: ``(K,)``; stamps ascend within a time line.
        world_from_body: ``(K, 4)`` xyzw.
        position: ``(K, 3)`` metres in the world, from odometry's steps and closures; NaN where unknown.
        position_dead_reckoned: ``(K, 3)`` metres, from odometry's steps alone, from its first position on; NaN without.
        odometry_world_from_body, odometry_position: ``(K, 4)`` xyzw and ``(K, 3)`` metres, odometry's own; NaN without.
    """

    node: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    time_line: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    position: NDArray[np.float64]
    position_dead_reckoned: NDArray[np.float64]
    odometry_world_from_body: NDArray[np.float64]
    odometry_position: NDArray[np.float64]

    @property
    def on_path(self) -> NDArray[np.int64]:
        """Rows of a path: keyframes of known position; all of them, at the origin, where no position is known."""
        known = np.flatnonzero(np.isfinite(self.position).all(axis=1))
        return known if len(known) else np.arange(len(self.node))


def corrected_trajectories(answer: Answer, odometry_of: Mapping[str, OdometrySamples]) -> dict[str, Trajectory]:
    """Poses of every robot's keyframes that have a stamp.

    Args:
        answer: with N keyframes and M edges; where an odometry edge has no translation, the odometry's own is used.
        odometry_of: messages by robot; they must not change meanwhile.

    Returns:
        the trajectories by robot; robots without such keyframes are left out.
    """
    from rotavg_ros.solver.positions import Translations, fit_positions  # loads SciPy, as below: a node may never ask

    nodes_of = {robot: nodes for robot in answer.robots if len(nodes := _nodes_by_time(answer, robot))}
    count = len(answer.keyframe_id)
    odometry = np.full((count, 4), np.nan), np.full((count, 3), np.nan)
    chain = np.full(count, -1)
    reckoned = np.full((count, 3), np.nan)
    for robot, nodes in nodes_of.items():
        samples = odometry_of.get(robot)
        if samples is not None and len(samples):
            odometry[0][nodes], odometry[1][nodes], chain[nodes] = samples.poses_at(
                answer.stamp_ns[nodes], answer.time_line[nodes]
            )
            reckoned[nodes] = dead_reckoning(
                answer.world_from_body[nodes], odometry[0][nodes], odometry[1][nodes], chain[nodes]
            )
    is_odometry = answer.kind == EdgeKind.ODOMETRY
    no_translation = np.isnan(answer.translation) & is_odometry[:, None]
    edges = Translations(
        answer.source,
        answer.target,
        np.where(no_translation, _odometry_steps(answer, *odometry, chain), answer.translation),
        is_odometry,
        np.where(answer.outlier, 1.0, answer.outlier_score),
        answer.steps,
    )
    if answer.position is None:
        position = fit_positions(answer.world_from_body, edges, reckoned)
    else:
        _, first = np.unique(answer.component, return_index=True)
        position = answer.position + np.nan_to_num(reckoned[first])[answer.component]
    position = np.where(np.isnan(position), reckoned, position)
    return {
        robot: Trajectory(
            nodes,
            answer.stamp_ns[nodes],
            answer.time_line[nodes],
            answer.world_from_body[nodes],
            position[nodes],
            reckoned[nodes],
            odometry[0][nodes],
            odometry[1][nodes],
        )
        for robot, nodes in nodes_of.items()
    }


def _nodes_by_time(answer: Answer, robot: str) -> NDArray[np.int64]:
    of_robot = answer.keyframe_robot == answer.robots.index(robot)
    nodes = np.flatnonzero(of_robot & (answer.stamp_ns != UNKNOWN_STAMP_NS))
    return nodes[np.lexsort((answer.stamp_ns[nodes], answer.time_line[nodes]))]


def _odometry_steps(
    answer: Answer, world_from_body: NDArray[np.float64], position: NDArray[np.float64], chain: NDArray[np.int64]
) -> NDArray[np.float64]:
    """``(M, 3)`` odometry's target position in the source's frame; NaN between robots or chains or without odometry."""
    source, target = answer.source, answer.target
    robot = answer.keyframe_robot
    known = (robot[source] == robot[target]) & (chain[source] == chain[target]) & (chain[source] >= 0)
    step = np.full((len(source), 3), np.nan)
    source, target = source[known], target[known]
    if len(source):
        from scipy.spatial.transform import Rotation

        step[known] = Rotation.from_quat(world_from_body[source]).inv().apply(position[target] - position[source])
    return step


def dead_reckoning(
    world_from_body: NDArray[np.float64],
    odometry_world_from_body: NDArray[np.float64],
    odometry_position: NDArray[np.float64],
    chain: NDArray[np.int64] | None = None,
) -> NDArray[np.float64]:
    """Odometry's steps, seen from the body, laid along other orientations.

    Args:
        world_from_body: ``(K, 4)`` xyzw, the orientations to use.
        odometry_world_from_body: ``(K, 4)`` xyzw, odometry's own; NaN where unknown.
        odometry_position: ``(K, 3)`` metres in odometry's frame; NaN likewise.
        chain: ``(K,)`` number of the odometry chain; the step from one chain to the next is unknown and taken as zero.

    Returns:
        ``(K, 3)`` metres; the first known position is odometry's. NaN where odometry's pose is unknown.
    """
    known = np.asarray(np.isfinite(np.hstack((odometry_world_from_body, odometry_position))).all(axis=1))
    position = np.where(known[:, None], odometry_position, np.nan)
    if known.sum() < 2:
        return position
    from scipy.spatial.transform import Rotation

    corrected, own = (Rotation.from_quat(turns[known]) for turns in (world_from_body, odometry_world_from_body))
    steps = (corrected * own.inv())[:-1].apply(np.diff(odometry_position[known], axis=0))
    if chain is not None:
        steps[np.diff(chain[known]) != 0] = 0.0
    position[known] = np.cumsum(np.vstack((odometry_position[known][:1], steps)), axis=0)
    return position
