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
from rotavg_ros.solver.slam.graph.evenly import evenly
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, Rival, moved
from rotavg_ros.solver.slam.poses.solved import PoseMode

_WRONG = 0.5
# Two closures agree about where a chain lies if they differ by less than this many standard deviations.
_ALIKE = 3.0
# Maximum number of rounds; of joins that are tried in each, those of most closures first; and of closures compared.
_MAX_ROUNDS, _MAX_JOINS, _MAX_COMPARED = 4, 8, 1000


class Join(NamedTuple):
    """A way to join two chains.

    Attributes:
        believed: closures that agree about where one lies beside the other.
        doubted: all other closures that join one of the two to any chain.
    """

    believed: np.ndarray
    doubted: np.ndarray


def joined_otherwise(rival: Rival) -> Rival:
    """The same labelling with chains placed by other closures, one after the other, as long as −log p falls."""
    if "joins" in rival.mode.problem.without:
        return rival
    tried: set[bytes] = set()
    for _ in range(_MAX_ROUNDS):
        for join in other_joins(rival.pose):
            key = join.believed.tobytes() + b"|" + join.doubted.tobytes()
            if key in tried:
                continue
            tried.add(key)
            placed = moved(rival, PoseStart.joining(rival.pose, *join))
            if placed.cost < rival.cost - LEAST_GAIN:
                rival = placed
                break
        else:
            break
    return rival


def other_joins(pose: PoseMode) -> list[Join]:
    """Groups of closures that would place a chain otherwise than it lies, those of most closures first.

    Either chain may be the one that is misplaced, so a group may be there twice; not where it has fewer runs than the
    closures that would have to be wrong.
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
    found: list[Join] = []
    is_left = np.ones(len(could), dtype=bool)
    while is_left.any() and len(found) < _MAX_JOINS:
        stop_if_abandoned()
        rest()
        seed = int(np.argmax(np.where(is_left, (alike & is_left).sum(axis=1), -1)))
        members = alike[seed] & is_left
        is_left &= ~members
        believed = could[members]
        for moving in pair[seed]:
            doubted = np.setdiff1d(joins[(chain[joins] == moving).any(axis=1)], believed)
            contradicted = doubted[places.right[doubted] > _WRONG]
            # The closures of a run repeat each other whether right or wrong, so a run counts once.
            if len(np.unique(told.run[believed])) >= len(np.unique(told.run[contradicted])):
                found.append(Join(believed, doubted))
    return found
