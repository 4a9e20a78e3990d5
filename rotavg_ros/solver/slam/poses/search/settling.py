"""A labelling of rotations, and what places make of it.

A labelling that rotations alone make likeliest need not be so with places: where places speak against a rotation's
label the label follows, rotations are solved anew, and so on as long as both together become likelier.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.em.convergence import Ending
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.search.jumps import log_jump_prior
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode

# Labels follow places so many times at most, as long as −log p falls by this, nats, and may come near the least so far.
_ROUNDS, LEAST_GAIN, HOPELESS = 4, 0.1, 20.0
_GOOD = 0.5
# Another start is tried if −log p is predicted to rise by no more than this, nats: what closures gain is told one by
# one, and a jump that was predicted to lose 4 gained 62.
SLACK = 8.0


@dataclass(frozen=True)
class Rival:
    """A labelling of rotations that places leave as it is.

    Attributes:
        mode: the labelling.
        pose: its poses, its labels held.
    """

    mode: Mode
    pose: PoseMode

    @property
    def cost(self) -> float:
        """−log p of rotations and translations, nats."""
        return self.mode.cost + self.pose.cost - log_jump_prior(self.pose.problem)

    def is_same(self, other: Rival) -> bool:
        """Whether both have the same labels."""
        return self.mode.labels == other.mode.labels and self.pose.jumps_like(other.pose)


def settling(pose: PoseMode, least: float = np.inf) -> Rival:
    """A labelling with labels of rotations as places have them, as long as both together become likelier by it.

    Args:
        pose: of the labelling to begin with.
        least: −log p of another one, nats; of one that is far from it no more is asked.
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
        # Closures that hold each other to be right, or wrong, may be less likely so all together.
        best = min(best, _held(begun, first), key=lambda rival: rival.cost)
    return best


def settled(problem: PoseProblem, start: PoseStart) -> Rival:
    """What a start comes to."""
    return settling(estimate_poses(problem, start=start))


def moved(rival: Rival, start: PoseStart) -> Rival:
    """What another start of the same labelling comes to; the same where places end as they were."""
    ending = Ending(until=rival.pose.solved.places)
    pose = estimate_poses(rival.pose.problem, start=start, ending=ending)
    is_same = pose.solved.places.is_like(rival.pose.solved.places)
    return rival if is_same else settling(pose, rival.cost)


def _held(problem: PoseProblem, pose: PoseMode) -> Rival:
    """A labelling as it is, from other poses."""
    return Rival(problem.mode, estimate_poses(problem, hold=True, start=PoseStart.at(pose)))


def relabelled(pose: PoseMode) -> Mode:
    """The labelling by which closures' rotations are right where places and rotations together say so."""
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
    return Mode(problem, *polish(problem, state), before.origin)
