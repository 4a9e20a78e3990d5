"""Places robots otherwise: by other ones of the closures that alone join two chains of odometry.

Nothing but these closures tells where one chain lies beside another. Those that are believed first hold the chain in
place, all that say otherwise are then judged wrong because of them, and no single one of these, nor a run, can move the
whole chain against the others. So for each group of such closures that agree about where the chain lies, poses are
estimated with that group believed and all that contradict it doubted, and −log p decides.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.running.work import rest, stop_if_abandoned
from rotavg_ros.solver.slam.graph.chain_cuts import ChainCuts, with_most_runs
from rotavg_ros.solver.slam.graph.evenly import evenly
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, Rival, moved
from rotavg_ros.solver.slam.poses.solved import PoseMode

_WRONG = 0.5
# Two closures agree about where a chain lies if they differ by less than this many standard deviations.
_ALIKE = 3.0
# Maximum number of rounds; of joins that are tried in each, those of most runs first; and of closures compared.
_MAX_ROUNDS, _MAX_JOINS, _MAX_COMPARED = 8, 8, 1000


class Join(NamedTuple):
    """A way to join two chains.

    Attributes:
        believed: closures that agree about where one lies beside the other.
        doubted: closures without which nothing else joins the two.
    """

    believed: np.ndarray
    doubted: np.ndarray


def joined_otherwise(rival: Rival) -> Rival:
    """The same labelling with chains placed by other closures, by those first that make all likeliest."""
    if "joins" in rival.mode.problem.without:
        return rival
    for _ in range(_MAX_ROUNDS):
        placed = [moved(rival, PoseStart.joining(rival.pose, *join)) for join in other_joins(rival.pose)]
        likeliest = min(placed, key=lambda each: each.cost, default=rival)
        if not likeliest.cost < rival.cost - LEAST_GAIN:
            break
        rival = likeliest
    return rival


def other_joins(pose: PoseMode) -> list[Join]:
    """Groups of closures that would place a chain otherwise than it lies, those of most runs first.

    What joins the two chains otherwise may be wrong where it is of fewest runs, or at either chain, so a group may be
    there several times; not where it has fewer runs than the closures that would have to be wrong.
    """
    problem, places, told = pose.problem, pose.solved.places, pose.problem.told
    closure, drawn, k = problem.mode.problem.closure, problem.drawn, problem.turns
    chain = np.stack((drawn.chain[drawn.source[closure]], drawn.chain[drawn.target[closure]]), axis=1)
    joins = np.flatnonzero((chain[:, 0] != chain[:, 1]) & told.is_known & (told.label == 0))
    could = joins[(places.right[joins] < _WRONG) & (places.rotation_good[joins] > _WRONG)]
    could = evenly(could[np.argsort(told.detected[could])], _MAX_COMPARED)
    if len(could) == 0:
        return []
    # By how much the chain of the higher number would move, and with which variance, lever arms included.
    sign = np.where(chain[could, 0] < chain[could, 1], 1.0, -1.0)
    shift = sign[:, None] * pose.solved.predictions.mean[could, k:]
    spread = np.diagonal(pose.solved.predictions.covariance[could][:, k:, k:], axis1=1, axis2=2).mean(axis=1)
    variance = spread + stated_variance(problem, pose.state)[could]
    pair = np.sort(chain[could], axis=1)
    square = ((shift[:, None] - shift[None]) ** 2).sum(axis=2) / (variance[:, None] + variance[None])
    alike = (square < _ALIKE**2 * shift.shape[1]) & (pair[:, None] == pair[None]).all(axis=2)
    names, ends = np.unique(chain[joins], return_inverse=True)
    ends, is_believed = ends.reshape(-1, 2), places.right[joins] > _WRONG
    cuts = ChainCuts.of(len(names), ends[is_believed], told.run[joins[is_believed]])
    found: list[Join] = []
    is_left = np.ones(len(could), dtype=bool)
    while is_left.any() and len(found) < _MAX_JOINS:
        stop_if_abandoned()
        rest()
        seed = with_most_runs(alike & is_left & is_left[:, None], told.run[could])
        members = alike[seed] & is_left
        is_left &= ~members
        believed, before = could[members], len(found)
        first, second = np.searchsorted(names, pair[seed])
        across = [beyond[ends[:, 0]] != beyond[ends[:, 1]] for beyond in cuts.beyond(first, second)]
        for is_doubted in (*across, *((ends == end).any(axis=1) for end in (first, second))):
            doubted = np.setdiff1d(joins[is_doubted], believed)
            contradicted = doubted[places.right[doubted] > _WRONG]
            is_enough = len(np.unique(told.run[believed])) >= len(np.unique(told.run[contradicted]))
            if is_enough and not any(np.array_equal(doubted, other.doubted) for other in found[before:]):
                found.append(Join(believed, doubted))
    return found
