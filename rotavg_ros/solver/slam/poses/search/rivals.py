"""Compares rival labellings by rotations and translations together: which are estimated, and which are left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.em.convergence import HELD, Ending
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses, likeliest_level
from rotavg_ros.solver.slam.poses.em.start import USUAL, PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import initial_noise
from rotavg_ros.solver.slam.poses.search.beginnings import begun_at_runs
from rotavg_ros.solver.slam.poses.search.joins import joined_otherwise
from rotavg_ros.solver.slam.poses.search.jumps import jumps_too_far, likeliest_jump, with_jump, without_odd_jumps
from rotavg_ros.solver.slam.poses.search.mending import without_slips
from rotavg_ros.solver.slam.poses.search.runs import with_runs, without_runs
from rotavg_ros.solver.slam.poses.search.settling import HOPELESS, NEAR, SLACK, Rival, settled, settling
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.view_graph import ViewGraph

# Maximum number of rival labellings compared by their translations, and of those published; and largest distance, nats,
# by rotations alone from the likeliest labelling, or the likeliest without slips.
_MAX_RIVALS, _FARTHEST = 8, 20.0
# Maximum number of labellings in which whole runs are believed or doubted.
_MAX_ASKED = 3
# Maximum number of jumps.
_MAX_JUMPS = 8


@dataclass(frozen=True)
class Rivals:
    """Labellings that translations do not rule out, the likeliest first.

    Attributes:
        modes: labellings.
        poses: poses of each labelling; here rotations are judged by places, too.
        share: probability of each.
        cost: −log p of the likeliest, of rotations and translations, nats.
    """

    modes: list[Mode]
    poses: list[PoseMode]
    share: np.ndarray
    cost: float


def rival_poses(
    graph: ViewGraph, translation: np.ndarray, modes: Sequence[Mode], tuned: Callable[[Mode], Mode] = lambda mode: mode
) -> Rivals:
    """Poses of labellings that translations do not rule out.

    Args:
        graph: the calibrated graph whose odometry was contracted.
        translation: ``(M, 3)`` metres.
        modes: labellings of its rotations, the likeliest first.
        tuned: function that sets each edge's noise in a labelling by FineNet, for its poses.
    """
    ended: list[Rival] = []
    begun: list[PoseMode] = []
    extent: float | None = None
    for mode in _first(modes):
        begun.append(_begun(PoseProblem(graph, translation, mode, extent=extent), begun))
        extent = begun[0].solved.scale.extent
    begun[0] = replace(begun[0], problem=replace(begun[0].problem, extent=extent))
    for pose in begun:
        ended.append(settling(pose, min((rival.cost for rival in ended), default=np.inf)))
    # Only once, for the likeliest labelling: odometry's error is a property of the robot, not of the labels.
    least = min(rival.cost for rival in ended)
    likeliest = next(pose for pose, rival in zip(begun, ended, strict=True) if rival.cost == least)
    if (other := _begun_otherwise(likeliest)) is not None:
        ended.append(settling(other, least))
    ended.extend(_with_other_runs(_distinct(ended, HOPELESS)[:_MAX_ASKED]))
    ended.append(without_slips(min(ended, key=lambda rival: rival.cost)))
    ended.append(begun_at_runs(min(ended, key=lambda rival: rival.cost)))
    ended.extend(_jumping(min(ended, key=lambda rival: rival.cost)))
    rivals = _distinct(ended, NEAR)[:_MAX_RIVALS]
    cost = np.array([rival.cost for rival in rivals])
    share = np.exp(cost[0] - cost)
    poses: list[PoseMode] = []
    for rival in rivals:
        problem = replace(rival.pose.problem, mode=tuned(rival.mode))
        poses.append(estimate_poses(problem, start=PoseStart.at(rival.pose)))
    return Rivals([rival.mode for rival in rivals], poses, share / share.sum(), float(cost[0]))


def _begun(problem: PoseProblem, others: Sequence[PoseMode]) -> PoseMode:
    """Poses of a labelling: estimated from scratch, or beginning at those of a labelling with nearly the same labels.

    Not if different segments slipped: everything between the two slips is displaced, and its closures' places change.
    """
    mode = problem.mode
    slips_alike = (pose for pose in others if np.array_equal(mode.slipped, pose.problem.mode.slipped))
    similar = next((pose for pose in slips_alike if mode.holds_like(pose.problem.mode.state)), None)
    start = None if similar is None else PoseStart.beside(similar, problem)
    return estimate_poses(problem, start=start)


def _distinct(ended: Sequence[Rival], farthest: float) -> list[Rival]:
    """Distinct labellings, likeliest first, without those less likely than the first by more than ``farthest`` nats."""
    rivals: list[Rival] = []
    for rival in sorted(ended, key=lambda rival: rival.cost):
        is_far = rivals and rival.cost > rivals[0].cost + farthest
        if not is_far and not any(rival.is_same(other) for other in rivals):
            rivals.append(rival)
    return rivals


def _with_other_runs(rivals: Sequence[Rival]) -> list[Rival]:
    """The rivals that are likelier with chains joined by other closures, or with whole runs believed or doubted.

    Also those with chains joined otherwise that are nearly as likely.

    A rival is skipped if this changed nothing in another one with nearly the same labels.
    """
    found: list[Rival] = []
    unmoved: list[Rival] = []
    for rival in rivals:
        if any(rival.mode.holds_like(other.mode.state) for other in unmoved):
            continue
        joined, *near = joined_otherwise(rival)
        other = without_runs(with_runs(joined))
        (unmoved if other is rival else found).append(other)
        found += near
    return found


def _jumping(rival: Rival) -> list[Rival]:
    """The same labelling with jumps of odometry's position, those that make it likelier or could be rivals."""
    before = rival.pose.problem
    if "jumps" in before.mode.problem.without:
        return []
    begun = [rival]
    # Closures that pull across a jump bend the map until right ones seem wrong, or odometry's variance grows until
    # nothing does. So jumps are also looked for before closures pull, and before variances grow.
    typical = np.array([before.typical, 1.0])
    has_grown = rival.pose.state.noise.of_odometry(typical) > initial_noise(before).of_odometry(typical)
    for solves in (1, HELD) if has_grown else (1,):
        jumped = _with_jumps(estimate_poses(before, ending=Ending(held_for=solves)))
        if jumped.problem is not before and not any(jumped.jumps_like(other.pose) for other in begun):
            begun.append(settled(jumped.problem, PoseStart.at(jumped)))
    found = [likelier for start in begun for likelier in _jumping_further(start)]
    for each in (*begun[1:], *found):
        if (problem := without_odd_jumps(each.pose)) is not None:
            found.append(settled(problem, PoseStart.at(each.pose)))
    return [jumped for jumped in (*begun[1:], *found) if not jumps_too_far(jumped.pose)]


def _jumping_further(rival: Rival) -> list[Rival]:
    rivals = [rival]
    for _ in range(_MAX_JUMPS):
        jump = likeliest_jump(rivals[-1].pose, -SLACK)
        if jump is None:
            break
        rivals.append(settled(*with_jump(rivals[-1].pose, jump)))
        if rivals[-1].cost > rivals[-2].cost:
            break
    return rivals[1:]


def _with_jumps(pose: PoseMode) -> PoseMode:
    """Poses with all jumps that are predicted to gain, most variances held at their initial values."""
    for _ in range(_MAX_JUMPS):
        jump = likeliest_jump(pose, 0.0)
        if jump is None:
            break
        problem, start = with_jump(pose, jump)
        pose = estimate_poses(problem, start=start, ending=Ending(held_for=HELD))
    return pose


def _first(modes: Sequence[Mode]) -> list[Mode]:
    """The labellings to estimate poses for; of several that turn the map alike, only the likeliest.

    A slip of rotations may imply an impossible jump of position. So the likeliest labellings without slips are kept,
    however unlikely they are by rotations alone: their distance counts from the likeliest without slips.
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
    """Poses of the same labelling from other initial variances, which odometry suggests; None if places end alike."""
    level = likeliest_level(usual)
    if level == USUAL:
        return None
    ending = Ending(until=usual.solved.places)
    other = estimate_poses(usual.problem, level=level, ending=ending)
    return None if other.solved.places.is_like(usual.solved.places) else other
