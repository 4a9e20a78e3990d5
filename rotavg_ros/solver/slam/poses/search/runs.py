"""Believe or doubt a whole run: closures that support each other's wrong class, although jointly it is less likely.

Each closure of a rejected run is judged wrong because its neighbours are. If all K closures of a run are right and none
of them pulls, all else predicts their discrepancies y as N(0, S), S = A H⁻¹ Aᵀ + V, with A their rows and V their own
variances. Where this is likelier than their current classes, poses are estimated anew with the run believed; −log p
decides, as between any two labellings.

Conversely, closures that join the same wrong places may bend the map until they fit, and each is judged right because
the others are. A run's common error is an unknown of its own: where all else predicts it to be far from zero, the run
is held to join wrong places, and poses are estimated anew.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from rotavg_ros.solver.algebra.products import inverse_of
from rotavg_ros.solver.running.work import rest, stop_if_abandoned
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.places.judge import Judge
from rotavg_ros.solver.slam.poses.repeats.neighbours import log_all_right
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, SLACK, Rival, moved
from rotavg_ros.solver.slam.poses.solved import PoseMode

# Number of runs that are examined, those first that are off by the fewest standard deviations; their least number of
# closures; and most closures of a run, whose result decides about the others.
_LOOKED_AT, _LEAST_MEMBERS, _MOST_MEMBERS = 32, 2, 96
_WRONG = 0.5
# Runs are doubted that would be as far off by chance with less than this probability.
_UNLIKELY = 0.05
# Most runs that are believed, or doubted, one after the other; and number of runs that are tried each time for doubt.
_MAX_RUNS, _MAX_DOUBTED = 8, 4


def with_runs(rival: Rival) -> Rival:
    """The same labelling with whole runs believed, as long as that is likelier."""
    if "believed-runs" in rival.mode.problem.without:
        return rival
    tried: set[bytes] = set()
    for _ in range(_MAX_RUNS):
        for gained, members in runs_to_believe(rival.pose):
            if gained < -SLACK or members.tobytes() in tried:
                continue
            tried.add(members.tobytes())
            believed = moved(rival, PoseStart.believing(rival.pose, members))
            if believed.cost < rival.cost - LEAST_GAIN:
                rival = believed
                break
        else:
            break
    return rival


def without_runs(rival: Rival) -> Rival:
    """The same labelling with whole runs doubted, as long as that is likelier."""
    if "doubted-runs" in rival.mode.problem.without:
        return rival
    for _ in range(_MAX_RUNS):
        doubted = [
            moved(rival, PoseStart.doubting(rival.pose, run)) for run in runs_to_doubt(rival.pose)[:_MAX_DOUBTED]
        ]
        likeliest = min(doubted, key=lambda each: each.cost, default=rival)
        if not likeliest.cost < rival.cost - LEAST_GAIN:
            break
        rival = with_runs(likeliest)
    return rival


def runs_to_believe(pose: PoseMode) -> list[tuple[float, np.ndarray]]:
    """By how many nats runs are likelier to be right than what they are held for, and their closures, best first."""
    told, places = pose.problem.told, pose.solved.places
    could = told.is_known & (told.label == 0) & (places.right < _WRONG)
    runs = _nearest(pose, could)
    if not runs:
        return []
    judge = Judge(told, pose.problem.turns, pose.problem.priors)
    in_order = judge(pose.solved.predictions, pose.solved.maps, places.chance, pose.solved.scale, in_order=True)
    found = [_Run.of(pose, members, in_order.log_density[members]) for members in runs]
    return sorted(((run.gained, run.members) for run in found if run is not None), key=lambda each: -each[0])


def runs_to_doubt(pose: PoseMode) -> list[np.ndarray]:
    """Closures of runs that are believed though all else says that they are off alike, the most unlikely first."""
    problem = pose.problem
    of_run, run = problem.run[problem.mode.problem.closure], problem.told.run
    could_be_wrong = problem.told.is_known & (problem.told.label == 0)
    believed = np.flatnonzero((pose.solved.places.right > _WRONG) & (of_run >= 0) & could_be_wrong)
    most = np.zeros(run.max(initial=-1) + 1)
    np.maximum.at(most, run[believed], unlikely_offsets(pose)[of_run[believed]])
    by_chance = chdtrc(problem.turns + problem.shifts, most)
    order = np.argsort(-most, kind="stable")
    members = [believed[run[believed] == each] for each in order[by_chance[order] < _UNLIKELY]]
    return [each for each in members if len(each) >= _LEAST_MEMBERS]


def unlikely_offsets(pose: PoseMode) -> np.ndarray:
    """``(R,)`` squares, in standard deviations, of what each run's closures err alike by all that others say of it.

    What a run has in common is a row of the system by itself: all other rows say N(μ, P) of it, which is whitened.
    """
    problem, solved = pose.problem, pose.solved
    row = len(problem.drawn.source) + np.arange(problem.num_runs)
    others, covariance = solved.factor.without(row)
    off = np.matmul(others, solved.left[row])
    return np.asarray((off * np.linalg.solve(covariance + np.eye(off.shape[1]), off)).sum(axis=(1, 2)))


def _nearest(pose: PoseMode, could: np.ndarray) -> list[np.ndarray]:
    """Members of runs that could be right, those first that are off by the fewest standard deviations in common."""
    told, predictions, k = pose.problem.told, pose.solved.predictions, pose.problem.turns
    count = np.bincount(told.run, could)
    off = np.stack([np.bincount(told.run, could * told.sign * column) for column in predictions.mean.T], axis=1)
    spread = np.diagonal(predictions.covariance, axis1=1, axis2=2)
    own = np.stack((told.rotation_variance, pose.solved.scale.good), axis=1)
    total = spread + np.repeat(own, [k, spread.shape[1] - k], axis=1)
    variance = np.stack([np.bincount(told.run, could * column) for column in total.T], axis=1)
    # Means of all members, of which each knows about the same.
    variance *= np.maximum(count, 1.0)[:, None]
    square = (off**2 / np.maximum(variance, np.finfo(np.float64).tiny)).sum(axis=1)
    order = np.argsort(np.where(count >= _LEAST_MEMBERS, square, np.inf), kind="stable")[:_LOOKED_AT]
    members = [np.flatnonzero(could & (told.run == run)) for run in order if count[run] >= _LEAST_MEMBERS]
    return [each[:_MOST_MEMBERS] for each in members]


@dataclass(frozen=True)
class _Run:
    """K closures that are likelier to be right together, each given the others, than what they are held for.

    Attributes:
        members: ``(K,)`` closures.
        gained: nats, by all of them.
    """

    members: np.ndarray
    gained: float

    @classmethod
    def of(cls, pose: PoseMode, members: np.ndarray, held: np.ndarray) -> _Run | None:
        """The largest such part of a run, which whoever gains least by being right leaves first; None if there is none.

        Args:
            pose: that none of them pulls.
            members: ``(n,)`` closures.
            held: ``(n,)`` nats, of each as it is held to be.
        """
        stop_if_abandoned()
        rest()
        d = pose.problem.turns + pose.problem.shifts
        total, off = _discrepancies(pose, members)
        precision = inverse_of(total)
        while len(members) >= _LEAST_MEMBERS:
            pulled = (precision @ off).reshape(-1, d)
            each = np.arange(len(members))
            own = precision.reshape(len(members), d, len(members), d)[each, :, each]
            # N(y_i given the others) of N(0, P⁻¹): P y and P's own blocks tell it.
            square = (pulled * np.linalg.solve(own, pulled[:, :, None])[:, :, 0]).sum(axis=1)
            given_others = (np.linalg.slogdet(own)[1] - square - d * np.log(2 * np.pi)) / 2
            least = int(np.argmin(given_others - held))
            if given_others[least] >= held[least]:
                log_density = np.linalg.slogdet(precision)[1] - off @ pulled.ravel() - len(off) * np.log(2 * np.pi)
                problem, places = pose.problem, pose.solved.places
                log_right = log_all_right(places.chance, problem.told, problem.priors, len(members))
                return cls(members, float(log_density / 2 - held.sum()) + log_right)
            # The inverse of what is left of the covariance, by that of all.
            stays = np.repeat(each != least, d)
            across = precision[np.ix_(stays, ~stays)]
            precision = precision[np.ix_(stays, stays)] - across @ np.linalg.solve(own[least], across.T)
            off = off[stays]
            members, held = np.delete(members, least), np.delete(held, least)
        return None


def _discrepancies(pose: PoseMode, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(K d, K d)`` covariance of a run's discrepancies if its closures are right, and these ``(K d,)``."""
    problem, solved, k = pose.problem, pose.solved, pose.problem.turns
    rows, d = problem.mode.problem.closure[members], problem.turns + problem.shifts
    own = np.repeat(problem.closure_turns(pose.state.noise)[members, None], d, axis=1)
    own[:, k:] = problem.own_variance(pose.state.noise)[members, None]
    total = solved.factor.covariance_between(problem.jacobian(solved.way)[rows], rows) + np.diag(own.ravel())
    return total, solved.predictions.mean[members].ravel()
