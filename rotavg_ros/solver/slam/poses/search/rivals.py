"""Rival labellings by rotations and translations together.

A labelling that rotations alone make likeliest need not be so with places: where places speak against a rotation's
label the label follows, rotations are solved anew, and so on as long as both together become likelier.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.estimate import HELD, USUAL, PoseMode, PoseStart, estimate_poses, likeliest_level
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.search.jumps import (
    jumps_too_far,
    likeliest_jump,
    log_jump_prior,
    with_jump,
    without_odd_jumps,
)
from rotavg_ros.solver.slam.poses.search.runs import runs_to_believe
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.view_graph import ViewGraph

# So many rival labellings are compared by their translations at most, none that rotations alone make less likely by
# more nats than the first of these than the likeliest, or the likeliest without slips; those that are less likely by no
# more than the second are published together.
_MAX_RIVALS, _FARTHEST, _FAR = 8, 20.0, 5.0
# Labels follow places so many times at most, as long as −log p falls by this, nats, and may come near the least so far.
_ROUNDS, _LEAST_GAIN, _HOPELESS = 4, 0.1, 20.0
_GOOD = 0.5
# A jump, or a run that is believed, is tried if −log p is predicted to rise by no more than this, nats: what closures
# gain is told one by one, and a jump that was predicted to lose 4 gained 62.
_SLACK = 8.0
# Jumps at most.
_MAX_JUMPS = 8
# Runs that are believed after all, at most, and in so many labellings.
_MAX_RUNS, _MAX_BELIEVING = 8, 3


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


@dataclass(frozen=True)
class Rivals:
    """What translations do not rule out, the likeliest first.

    Attributes:
        modes: labellings.
        poses: of each, rotations judged by places, too.
        share: probabilities.
    """

    modes: list[Mode]
    poses: list[PoseMode]
    share: np.ndarray


def rival_poses(
    graph: ViewGraph, translation: np.ndarray, modes: Sequence[Mode], tuned: Callable[[Mode], Mode] = lambda mode: mode
) -> Rivals:
    """Poses of labellings that translations do not rule out.

    Args:
        graph: whose odometry was drawn together, without its bias.
        translation: ``(M, 3)`` metres.
        modes: labellings of its rotations, the likeliest first.
        tuned: the same labelling with the noise of each edge as FineNet has it, for its poses.
    """
    ended: list[Rival] = []
    begun = [estimate_poses(PoseProblem(graph, translation, mode)) for mode in _first(modes)]
    for pose in begun:
        ended.append(settling(pose, min((rival.cost for rival in ended), default=np.inf)))
    least = min(rival.cost for rival in ended)
    for pose, rival in zip(begun, ended[: len(begun)], strict=True):
        if rival.cost < least + _HOPELESS and (other := _begun_otherwise(pose)) is not None:
            ended.append(settling(other, least))
    ended.extend([_with_runs(rival) for rival in _distinct(ended, _HOPELESS)[:_MAX_BELIEVING]])
    ended.extend(_jumping(min(ended, key=lambda rival: rival.cost)))
    rivals = _distinct(ended, _FAR)
    cost = np.array([rival.cost for rival in rivals])
    share = np.exp(cost[0] - cost)
    poses: list[PoseMode] = []
    for rival in rivals:
        problem = replace(rival.pose.problem, mode=tuned(rival.mode))
        poses.append(estimate_poses(problem, start=PoseStart.at(rival.pose)))
    return Rivals([rival.mode for rival in rivals], poses, share / share.sum())


def _distinct(ended: Sequence[Rival], farthest: float) -> list[Rival]:
    """The likeliest of each labelling, but for those that are less likely than the first by more than some nats."""
    rivals: list[Rival] = []
    for rival in sorted(ended, key=lambda rival: rival.cost):
        is_far = rivals and rival.cost > rivals[0].cost + farthest
        if not is_far and not any(rival.is_same(other) for other in rivals):
            rivals.append(rival)
    return rivals


def _with_runs(rival: Rival) -> Rival:
    """The same labelling with whole runs believed, as long as that is likelier."""
    if "believed-runs" in rival.mode.problem.without:
        return rival
    tried: set[bytes] = set()
    for _ in range(_MAX_RUNS):
        for gained, members in runs_to_believe(rival.pose):
            if gained < -_SLACK or members.tobytes() in tried:
                continue
            tried.add(members.tobytes())
            believed = _settled(rival.pose.problem, PoseStart.believing(rival.pose, members))
            if believed.cost < rival.cost - _LEAST_GAIN:
                rival = believed
                break
        else:
            break
    return rival


def _jumping(rival: Rival) -> list[Rival]:
    """The same labelling with odometry's position jumping, as long as that is likelier, or would be a rival."""
    before = rival.pose.problem
    if "jumps" in before.mode.problem.without:
        return []
    begun = [rival]
    # With a jump what is right may be given up, or odometry seems to err by more everywhere until nothing seems wrong:
    # they are looked for before closures pull, and before variances grow.
    has_grown = rival.pose.state.noise.way > before.turn_noise.way
    for solves in (1, HELD) if has_grown else (1,):
        jumped = _with_jumps(estimate_poses(before, held_for=solves))
        if jumped.problem is not before and not any(jumped.jumps_like(other.pose) for other in begun):
            begun.append(_settled(jumped.problem, PoseStart.at(jumped)))
    found = [likelier for start in begun for likelier in _jumping_further(start)]
    for each in (*begun[1:], *found):
        if (problem := without_odd_jumps(each.pose)) is not None:
            found.append(_settled(problem, PoseStart.at(each.pose)))
    return [jumped for jumped in (*begun[1:], *found) if not jumps_too_far(jumped.pose)]


def _jumping_further(rival: Rival) -> list[Rival]:
    rivals = [rival]
    for _ in range(_MAX_JUMPS):
        jump = likeliest_jump(rivals[-1].pose)
        if jump is None or jump.gained < -_SLACK:
            break
        rivals.append(_settled(*with_jump(rivals[-1].pose, jump)))
        if rivals[-1].cost > rivals[-2].cost:
            break
    return rivals[1:]


def _settled(problem: PoseProblem, start: PoseStart) -> Rival:
    return settling(estimate_poses(problem, start=start))


def _with_jumps(pose: PoseMode) -> PoseMode:
    """Poses with all jumps that gain, most variances as they began."""
    for _ in range(_MAX_JUMPS):
        jump = likeliest_jump(pose)
        if jump is None or jump.gained < 0:
            break
        problem, start = with_jump(pose, jump)
        pose = estimate_poses(problem, start=start, held_for=HELD)
    return pose


def _first(modes: Sequence[Mode]) -> list[Mode]:
    """Those to begin with, of which none turns everything as another one does.

    Odometry that slipped by rotations alone may have had to jump, so places are asked of labellings without slips,
    however unlikely rotations alone make these: they are counted from the likeliest of their own.
    """
    unslipped = min((mode.cost for mode in modes if len(mode.slipped) == 0), default=np.inf)
    first: list[Mode] = []
    for mode in modes:
        best = unslipped if len(mode.slipped) == 0 else modes[0].cost
        is_far = mode.cost > best + _FARTHEST
        if not is_far and not any(mode.is_turned_like(other.state) for other in first):
            first.append(mode)
    last = next((mode for mode in first[_MAX_RIVALS:] if mode.cost == unslipped), None)
    return first[:_MAX_RIVALS] + ([] if last is None else [last])


def _begun_otherwise(usual: PoseMode) -> PoseMode | None:
    """Poses of the same labelling, begun with the noise that odometry tells of in the place of what is believed."""
    level = likeliest_level(usual.problem)
    if level == USUAL:
        return None
    other = estimate_poses(usual.problem, level=level, until=usual)
    return None if other.solved.places.is_like(usual.solved.places) else other


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
        if best is not None and rival.cost > best.cost - _LEAST_GAIN:
            break
        best = rival
        if best.cost > least + _HOPELESS:
            break
        pose = estimate_poses(rival.pose.problem, start=PoseStart.at(rival.pose))
    assert best is not None
    if best.mode.labels != begun.mode.labels and best.cost < least + _HOPELESS:
        # Closures that hold each other to be right, or wrong, may be less likely so all together.
        best = min(best, _held(begun, first), key=lambda rival: rival.cost)
    return best


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
