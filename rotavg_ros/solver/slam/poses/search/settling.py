"""Adapts a labelling of rotations to the evidence from places.

The likeliest labelling by rotations alone need not be the likeliest with places. Where places contradict a rotation's
label, the label is changed and rotations are solved anew, as long as both together become likelier.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.em.convergence import Ending
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.search.jumps import log_jump_prior
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.em import polish_fully
from rotavg_ros.solver.slam.posterior.mode import Mode

# Maximum number of rounds of relabelling; least decrease of −log p for another round, nats; and distance from the least
# −log p so far at which a labelling is given up, nats.
_ROUNDS, LEAST_GAIN, HOPELESS = 4, 0.1, 20.0
# Largest distance from the least −log p, nats, of labellings that are published together.
NEAR = 5.0
_GOOD = 0.5
# Another start is tried if −log p is predicted to rise by no more than this, nats: the gain is predicted for each
# closure independently, and a jump that was predicted to lose 4 gained 62.
SLACK = 8.0


@dataclass(frozen=True)
class Rival:
    """A labelling of rotations with its poses.

    Attributes:
        mode: the labelling.
        pose: its poses, estimated with labels held.
    """

    mode: Mode
    pose: PoseMode

    @property
    def cost(self) -> float:
        """−log p of rotations and translations, nats."""
        return self.mode.cost + self.pose.cost - log_jump_prior(self.pose.problem)

    def is_same(self, other: Rival) -> bool:
        """Whether both have the same labels, and chains that the same closures join."""
        is_labelled_alike = self.mode.labels == other.mode.labels
        return is_labelled_alike and self.pose.jumps_like(other.pose) and self.pose.is_joined_like(other.pose)


def settling(pose: PoseMode, least: float = np.inf) -> Rival:
    """Relabels rotations by the evidence from places, as long as both together become likelier.

    Args:
        pose: poses of the labelling to begin with.
        least: −log p of another labelling, nats; a labelling far above it is not pursued.
    """
    begun, first, best = pose.problem, pose, None
    for _ in range(_ROUNDS):
        mode = relabelled(pose)
        if best is not None and mode.labels == best.mode.labels:
            break
        rival = _held(replace(begun, mode=mode), pose)
        if best is not None and rival.cost > best.cost - LEAST_GAIN:
            break
        best = rival
        if best.cost > least + HOPELESS or mode is pose.problem.mode:
            break
        pose = estimate_poses(rival.pose.problem, start=PoseStart.at(rival.pose))
    assert best is not None
    if best.mode.labels != begun.mode.labels and best.cost < least + HOPELESS:
        # Closures that support each other's labels one by one may be less likely with these labels jointly.
        best = min(best, _held(begun, first), key=lambda rival: rival.cost)
    return best


def settled(problem: PoseProblem, start: PoseStart) -> Rival:
    """The rival that a start of a problem leads to."""
    return settling(estimate_poses(problem, start=start))


def moved(rival: Rival, start: PoseStart, *, is_for_more: bool = False) -> Rival:
    """The rival that another start of the same labelling leads to; ``rival`` itself if places end as they were.

    Args:
        rival: the labelling with its poses.
        start: where to begin.
        is_for_more: ``rival`` itself also where no closure is believed that it rejects.
    """
    ending = Ending(until=rival.pose.solved.places, is_for_more=is_for_more)
    pose = estimate_poses(rival.pose.problem, start=start, ending=ending)
    return rival if ending.is_reached(pose.solved.places) else settling(pose, rival.cost)


def _held(problem: PoseProblem, pose: PoseMode) -> Rival:
    """The rival of ``problem``'s labelling, with labels held; its estimate begins at ``pose``."""
    return Rival(problem.mode, estimate_poses(problem, hold=True, start=PoseStart.at(pose)))


def relabelled(pose: PoseMode) -> Mode:
    """The labelling in which closures are good where places and rotations together favour it."""
    before = pose.problem.mode
    problem = before.problem
    closure = problem.closure
    is_told = np.isinf(problem.log_odds[closure])
    if "relabelling" in problem.without:
        return before
    trusted = before.state.trusted.copy()
    trusted[closure] = np.where(is_told, trusted[closure], pose.solved.places.rotation_good > _GOOD)
    if np.array_equal(trusted, before.state.trusted):
        return before
    state = replace(before.state, correction=pose.state.correction, trusted=trusted)
    return Mode(problem, *polish_fully(problem, state), before.origin)
