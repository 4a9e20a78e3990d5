"""Believes or doubts whole runs: their closures support each other's class, although jointly another one is likelier.

Each closure of a rejected run is judged wrong because its neighbours are. If all K closures of a run are right and none
of them pulls, the other rows predict their discrepancies y as N(0, S), S = A H⁻¹ Aᵀ + V, with A their rows and V their
own variances. If this is likelier than their current classes, poses are estimated again with the run believed, and
−log p decides, as between any two labellings.

Conversely, closures that join the same wrong places may bend the map until they fit; each is then judged right because
the others are. A run's common error is an unknown of its own. If the other rows predict it to be far from zero, the run
is held to join wrong places, and poses are estimated again.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from rotavg_ros.solver.algebra.products import inverse_of
from rotavg_ros.solver.running.work import rest, stop_if_abandoned
from rotavg_ros.solver.slam.poses.em.estimate import judge_of
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.repeats.neighbours import log_all_right
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.search.discrepancies import discrepancies
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, SLACK, Rival, moved
from rotavg_ros.solver.slam.poses.solved import PoseMode

# Maximum number of rejected runs that are examined, those with the smallest mean offset first; minimum number of
# closures in a run; and maximum number of its closures that are examined. The rest of a longer run follows in the
# estimate that begins with these believed.
_LOOKED_AT, _LEAST_MEMBERS, MOST_MEMBERS = 32, 2, 96
_WRONG = 0.5
# Expected share of right runs among those doubted, at most.
_UNLIKELY = 0.05
# Maximum number of rounds of believing, or of doubting; and number of runs that each round of doubting tries.
_MAX_RUNS, _MAX_DOUBTED = 8, 4


def with_runs(rival: Rival) -> Rival:
    """The same labelling with whole runs believed, one after the other, as long as −log p falls."""
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
    """The same labelling with whole runs doubted, one after the other, as long as −log p falls."""
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
    """Rejected runs that may be right: gain in nats over their current classes, and closures; largest gain first."""
    told, places = pose.problem.told, pose.solved.places
    could = told.is_known & (told.label == 0) & (places.right < _WRONG)
    runs = _nearest(pose, could)
    if not runs:
        return []
    judge = judge_of(pose.problem)
    in_order = judge(pose.solved.predictions, pose.solved.maps, places.chance, pose.solved.scale, in_order=True)
    found = [_Run.of(pose, members, in_order.log_density[members]) for members in runs]
    return sorted(((run.gained, run.members) for run in found if run is not None), key=lambda each: -each[0])


def runs_to_doubt(pose: PoseMode) -> list[np.ndarray]:
    """Closures of believed runs whose common error is improbably large, the most improbable run first."""
    problem = pose.problem
    of_run, run = problem.run[problem.mode.problem.closure], problem.told.run
    could_be_wrong = problem.told.is_known & (problem.told.label == 0)
    believed = np.flatnonzero((pose.solved.places.right > _WRONG) & (of_run >= 0) & could_be_wrong)
    most = np.zeros(run.max(initial=-1) + 1)
    np.maximum.at(most, run[believed], unlikely_offsets(pose)[of_run[believed]])
    large = np.flatnonzero(np.bincount(run[believed], minlength=len(most)) >= _LEAST_MEMBERS)
    improbable = large[too_large(most[large], problem.turns + problem.shifts)]
    return [believed[run[believed] == each] for each in improbable]


def too_large(square: np.ndarray, components: int) -> np.ndarray:
    """Which of ``(n,)`` squares in as many components are improbable among so many, the largest first.

    By step-up bounds (Benjamini & Hochberg 1995): of a hundred right runs five have an error that would be improbable
    by itself, and an estimate without each takes about as long as the first one.
    """
    order = np.argsort(-square, kind="stable")
    bound = _UNLIKELY * np.arange(1, len(order) + 1) / max(len(order), 1)
    last = np.flatnonzero(chdtrc(components, square[order]) <= bound).max(initial=-1)
    return np.asarray(order[: last + 1])


def unlikely_offsets(pose: PoseMode) -> np.ndarray:
    """``(R,)`` squared Mahalanobis distance of each run's common error from zero, as all other rows predict it.

    The prior of a run's common error is a row of the system. All other rows predict that row's residual as N(μ, P), in
    units of its prior standard deviation.
    """
    problem, solved = pose.problem, pose.solved
    row = len(problem.drawn.source) + np.arange(problem.num_runs)
    others, covariance = solved.factor.without(row)
    off = np.matmul(others, solved.left[row])
    return np.asarray((off * np.linalg.solve(covariance + np.eye(off.shape[1]), off)).sum(axis=(1, 2)))


def run_discrepancies(pose: PoseMode, could: np.ndarray) -> np.ndarray:
    """``(R,)`` squares of each run's mean discrepancy, in standard deviations of its predictions by all else.

    Of those of its closures that ``could (C,)`` marks; infinite for less than two.
    """
    told, predictions, k = pose.problem.told, pose.solved.predictions, pose.problem.turns
    count = np.bincount(told.run, could)
    off = np.stack([np.bincount(told.run, could * told.sign * column) for column in predictions.mean.T], axis=1)
    spread = np.diagonal(predictions.covariance, axis1=1, axis2=2)
    good = stated_variance(pose.problem, pose.state)
    own = np.stack((told.rotation_variance, good), axis=1)
    total = spread + np.repeat(own, [k, spread.shape[1] - k], axis=1)
    variance = np.stack([np.bincount(told.run, could * column) for column in total.T], axis=1)
    # The members' predictions are nearly the same, so their errors count as fully correlated.
    variance *= np.maximum(count, 1.0)[:, None]
    square = (off**2 / np.maximum(variance, np.finfo(np.float64).tiny)).sum(axis=1)
    return np.asarray(np.where(count >= _LEAST_MEMBERS, square, np.inf))


def _nearest(pose: PoseMode, could: np.ndarray) -> list[np.ndarray]:
    """Closures of each rejected run, the run whose mean discrepancy is the fewest standard deviations first."""
    run, square = pose.problem.told.run, run_discrepancies(pose, could)
    order = np.argsort(square, kind="stable")[:_LOOKED_AT]
    return [np.flatnonzero(could & (run == each))[:MOST_MEMBERS] for each in order if np.isfinite(square[each])]


@dataclass(frozen=True)
class _Run:
    """K closures of a run, each of which is likelier to be right, given the others, than its current class.

    Attributes:
        members: ``(K,)`` closures.
        gained: nats, by which all of them together are likelier if they are right.
    """

    members: np.ndarray
    gained: float

    @classmethod
    def of(cls, pose: PoseMode, members: np.ndarray, held: np.ndarray) -> _Run | None:
        """The part of a run that is left after removing, one by one, the closure that gains least; None if none is.

        Args:
            pose: poses in which none of them pulls.
            members: ``(n,)`` closures.
            held: ``(n,)`` nats, log density of each under its current classes.
        """
        stop_if_abandoned()
        rest()
        d = pose.problem.turns + pose.problem.shifts
        total, off = discrepancies(pose, members)
        precision = inverse_of(total)
        while len(members) >= _LEAST_MEMBERS:
            pulled = (precision @ off).reshape(-1, d)
            each = np.arange(len(members))
            own = precision.reshape(len(members), d, len(members), d)[each, :, each]
            # The conditional density of y_i given the others, for y ~ N(0, P⁻¹), needs only P y and P's blocks.
            square = (pulled * np.linalg.solve(own, pulled[:, :, None])[:, :, 0]).sum(axis=1)
            given_others = (np.linalg.slogdet(own)[1] - square - d * np.log(2 * np.pi)) / 2
            least = int(np.argmin(given_others - held))
            if given_others[least] >= held[least]:
                log_density = np.linalg.slogdet(precision)[1] - off @ pulled.ravel() - len(off) * np.log(2 * np.pi)
                problem, places = pose.problem, pose.solved.places
                log_right = log_all_right(places.chance, problem.told, problem.priors, len(members))
                return cls(members, float(log_density / 2 - held.sum()) + log_right)
            # Inverse of the remaining covariance, by a Schur complement of the whole inverse.
            stays = np.repeat(each != least, d)
            across = precision[np.ix_(stays, ~stays)]
            precision = precision[np.ix_(stays, stays)] - across @ np.linalg.solve(own[least], across.T)
            off = off[stays]
            members, held = np.delete(members, least), np.delete(held, least)
        return None
