"""Poses of a robot's graph after its rotations were solved."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from rotavg_ros.solver.algebra.odometry_lengths import typical_length, ways_passed
from rotavg_ros.solver.running.kept_labels import KeptLabels
from rotavg_ros.solver.slam.graph.odometry_paths import beside_the_chain
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.publishing.answer import answer
from rotavg_ros.solver.slam.poses.search.rivals import rival_poses
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.view_graph import ViewGraph

_GOOD = 0.5
# Metres; odometry with a longer step gives no places, so that squares do not overflow.
_ABSURD = 1e100
# Odometry gives no places either where the square of its longest step is rounded by more than this, in typical steps
# squared: what all else predicts across that step is a difference of such squares. Odometry and closures usually err by
# a hundredth of a step and more. (Steps of 10^6 m among usual ones of .5 m ended in singular covariances.)
_ROUNDED = 1e-2**2


def has_places(graph: ViewGraph) -> bool:
    """Whether translations of the odometry chain and of some other edges are known, and odometry moves at all."""
    if graph.translation is None:
        return False
    known = (graph.translation.abs() < _ABSURD).all(dim=1)
    chain = graph.is_odometry
    if not known[chain].all() or not known[~chain].any():
        chain = chain & torch.from_numpy(~beside_the_chain(graph))
    moves = bool(graph.translation[chain].any())
    return moves and bool(known[chain].all()) and bool(known[~chain].any()) and _is_resolved(graph, chain.numpy())


def _is_resolved(graph: ViewGraph, chain: np.ndarray) -> bool:
    """Whether squares of the longest step of odometry, ``(M,)`` bool, resolve that of what a typical one errs by."""
    way, steps = ways_passed(_translations(graph)[chain]), graph.steps.numpy()[chain]
    farthest = np.sqrt(_ROUNDED / np.finfo(np.float64).eps)
    # The median of all is no longer than a typical step, and takes a tenth of the time.
    if way.max() < farthest * np.median(way / steps):
        return True
    return bool(way.max() < farthest * typical_length(way, steps, np.ones(len(way), dtype=bool)))


class Median(NamedTuple):
    """Poses and their labelling, the median of those that rotations and translations make likely.

    Attributes:
        memory: the poses.
        mode: the labelling.
        cost: −log p of the likeliest labelling, nats; NaN where there are no closures to decide by.
    """

    memory: PoseMemory
    mode: Mode
    cost: float

    @property
    def is_contradicted(self) -> bool:
        """Whether most closures of known translations whose rotations are right join wrong places."""
        pose = self.memory.pose
        places = pose.solved.places
        is_turned_right = (places.rotation_good > _GOOD) & pose.problem.told.is_known
        return 2 * int((is_turned_right & (places.right > _GOOD)).sum()) < int(is_turned_right.sum())


def median_poses(graph: ViewGraph, modes: list[Mode], tuned: Callable[[Mode], Mode] = lambda mode: mode) -> Median:
    """The median of the poses that rotations and translations make likely.

    Args:
        graph: calibrated, with translations.
        modes: labellings of its rotations, the likeliest first.
        tuned: function that sets each edge's noise in a labelling by FineNet.
    """
    if len(modes[0].problem.closure) == 0:
        return Median(poses_of_labels(graph, tuned(modes[0])), modes[0], np.nan)
    rivals = rival_poses(graph, _translations(graph), modes, tuned)
    poses, middle = answer(rivals.poses, rivals.share)
    return Median(PoseMemory.of(rivals.poses[middle], poses), rivals.modes[middle], rivals.cost)


def poses_of_update(graph: ViewGraph, mode: Mode, memory: PoseMemory) -> PoseMemory:
    """Poses of a calibrated graph that has grown, with the labels of its rotations."""
    problem = memory.problem(graph, _translations(graph), mode)
    return _remembered(estimate_poses(problem, start=memory.start(graph, problem)))


def poses_of_labels(graph: ViewGraph, mode: Mode) -> PoseMemory:
    """Poses of a calibrated graph, from the labels of its rotations alone."""
    return _remembered(estimate_poses(PoseProblem(graph, _translations(graph), mode)))


def poses_of_kept(graph: ViewGraph, mode: Mode, kept: KeptLabels) -> PoseMemory:
    """Poses of a calibrated graph, from the labels of its rotations and the kept classes of its closures' places."""
    problem = PoseProblem(graph, _translations(graph), mode)
    return _remembered(estimate_poses(problem, start=PoseStart.kept(problem, kept.places, kept.pose_noise)))


def _remembered(pose: PoseMode) -> PoseMemory:
    """The memory of a single labelling's poses."""
    return PoseMemory.of(pose, answer([pose], np.ones(1))[0])


def _translations(graph: ViewGraph) -> np.ndarray:
    assert graph.translation is not None
    return np.asarray(graph.translation.numpy())
