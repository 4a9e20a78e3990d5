"""Places robots otherwise: by other ones of the closures that alone join two chains of odometry.

Nothing but these closures tells where one chain lies beside another. Those that are believed first hold the chain in
place, all that say otherwise are then judged wrong because of them, and no single one of these, nor a run, can move the
whole chain against the others. So for each group of such closures that agree about how the chain should move, poses are
estimated with that group believed and all that contradict it doubted, and −log p decides. Where it should turn as well,
rotations are solved anew before.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.running.work import rest, stop_if_abandoned
from rotavg_ros.solver.slam.graph.chain_cuts import ChainCuts, connected, with_most_runs
from rotavg_ros.solver.slam.graph.evenly import evenly
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.search.motions import Motions
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, NEAR, Rival, moved, settling
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.em import polish_fully
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.turning import sides_turned, trusted_after_turn

_WRONG = 0.5
# Maximum number of rounds; of joins that are tried in each, those of most runs first; and of closures compared.
_MAX_ROUNDS, _MAX_JOINS, _MAX_COMPARED = 8, 8, 1000
# A group is not tried if another one of the same two chains has more than twice its runs: among many random joins some
# agree by chance.
_LEAST_SHARE = 0.5


class Join(NamedTuple):
    """A way to join two chains.

    Attributes:
        believed: closures that agree about where one lies beside the other.
        doubted: closures without which nothing else joins the two.
        moving, resting: ``(K,)`` bool, key nodes that move, and those that they move against.
        turn: ``(4, 1)`` by which the corrections of ``moving`` turn.
    """

    believed: np.ndarray
    doubted: np.ndarray
    moving: np.ndarray
    resting: np.ndarray
    turn: np.ndarray


def joined_otherwise(rival: Rival) -> list[Rival]:
    """The labelling with chains placed by other closures, by those first that make all likeliest.

    Returns:
        The likeliest, ``rival`` itself if none is likelier; and others that are nearly as likely.
    """
    if "joins" in rival.mode.problem.without:
        return [rival]
    tried = [rival]
    for _ in range(_MAX_ROUNDS):
        placed = [_placed(rival, join) for join in other_joins(rival.pose)]
        tried += [each for each in placed if each is not rival]
        likeliest = min(placed, key=lambda each: each.cost, default=rival)
        if not likeliest.cost < rival.cost - LEAST_GAIN:
            break
        rival = likeliest
    distinct = [rival]
    for each in sorted(tried, key=lambda each: each.cost):
        is_near = each.cost <= rival.cost + NEAR
        if is_near and not any(each.pose.is_joined_like(other.pose) for other in distinct):
            distinct.append(each)
    return distinct


def _placed(rival: Rival, join: Join) -> Rival:
    pose = rival.pose
    if (pose.solved.places.rotation_good[join.believed] > _WRONG).all():
        return moved(rival, PoseStart.joining(pose, join.believed, join.doubted))
    problem = replace(pose.problem, mode=_turned(rival.mode, join))
    start = PoseStart.joining(pose, join.believed, join.doubted).along_odometry(problem)
    return settling(estimate_poses(problem, start=start), rival.cost)


def _turned(mode: Mode, join: Join) -> Mode:
    """The labelling of rotations that a way to join chains implies."""
    problem = mode.problem
    state = sides_turned(mode, join.moving, join.resting, join.turn)
    trusted = trusted_after_turn(mode, state)
    trusted[problem.closure[join.doubted]], trusted[problem.closure[join.believed]] = 0.0, 1.0
    return Mode(problem, *polish_fully(problem, replace(state, trusted=trusted)), mode.origin)


def other_joins(pose: PoseMode) -> list[Join]:
    """Groups of closures that would place a chain otherwise than it lies, those of most runs first.

    What joins the two chains otherwise may be wrong where it is of fewest runs, or at either chain, so a group may be
    there several times; not where it has fewer runs than the closures that would have to be wrong, or than half of
    those of another group.
    """
    problem, places, told = pose.problem, pose.solved.places, pose.problem.told
    names, number = np.unique(problem.drawn.chain, return_inverse=True)
    ends = problem.chains
    joins = np.flatnonzero((ends[:, 0] != ends[:, 1]) & told.is_known & (told.label == 0))
    could = joins[places.right[joins] < _WRONG]
    could = evenly(could[np.argsort(told.detected[could])], _MAX_COMPARED)
    if len(could) == 0:
        return []
    pair, motions = np.sort(ends[could], axis=1), Motions.of(pose, could)
    alike = motions.agree(problem.turns, problem.shifts) & (pair[:, None] == pair[None]).all(axis=2)
    believing = joins[places.right[joins] > _WRONG]
    cuts, component = ChainCuts.of(len(names), ends[believing], told.run[believing]), connected(len(names), ends)
    alone = np.eye(len(names), dtype=bool)
    most: dict[tuple[int, int], int] = {}
    found: list[Join] = []
    is_left = np.ones(len(could), dtype=bool)
    while is_left.any() and len(found) < _MAX_JOINS:
        stop_if_abandoned()
        rest()
        seed = with_most_runs(alike & is_left & is_left[:, None], told.run[could])
        members = alike[seed] & is_left
        is_left &= ~members
        believed, before, (first, second) = could[members], len(found), pair[seed].tolist()
        runs = len(np.unique(told.run[believed]))
        if runs < _LEAST_SHARE * most.setdefault((first, second), runs):
            is_left &= (pair != pair[seed]).any(axis=1)  # groups of most runs come first
            continue
        is_near = component == component[first]
        for beyond in (*cuts.beyond(first, second), ~alone[first], alone[second]):
            crossing = joins[beyond[ends[joins, 0]] != beyond[ends[joins, 1]]]
            doubted = np.setdiff1d(crossing, believed)
            is_enough = runs >= len(np.unique(told.run[doubted[places.right[doubted] > _WRONG]]))
            if is_enough and not any(np.array_equal(doubted, other.doubted) for other in found[before:]):
                moving, resting = (beyond & is_near)[number], (~beyond & is_near)[number]
                found.append(Join(believed, doubted, moving, resting, motions.turn[:, [seed]]))
    return found
