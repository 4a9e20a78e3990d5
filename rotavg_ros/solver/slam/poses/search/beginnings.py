"""Begins once more at a rejected run, where odometry alone predicts it better than a run that is believed.

Which of two groups of closures that contradict each other is believed depends on which one pulled first. So poses are
estimated from rotations alone again, with such a run believed before all others, and −log p decides.
"""

from __future__ import annotations

from itertools import islice

import numpy as np

from rotavg_ros.solver.slam.poses.em.convergence import Ending
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.search.runs import MOST_MEMBERS, run_discrepancies, with_runs, without_runs
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, Rival, moved
from rotavg_ros.solver.slam.poses.solved import PoseMode

# Maximum number of rounds, and of runs that are tried in each, those that odometry predicts best first.
_MAX_ROUNDS, _MAX_RUNS = 4, 3
_WRONG = 0.5
# Number of standard deviations, in each component, by which closures of a run differ at most that agree; what odometry
# errs by between them is included.
_FAR = 5.0


def begun_at_runs(rival: Rival) -> Rival:
    """The same labelling begun at rejected runs, as long as −log p falls."""
    if "other-beginnings" in rival.mode.problem.without:
        return rival
    tried: set[bytes] = set()
    for _ in range(_MAX_ROUNDS):
        for members in runs_to_begin_at(rival.pose):
            if members.tobytes() in tried:
                continue
            tried.add(members.tobytes())
            # Once all of the run is rejected again, what is left is the beginning with no run, which comes last.
            begun = moved(rival, PoseStart.anew(rival.pose, members), is_for_more=len(members) > 0)
            if begun.cost < rival.cost - LEAST_GAIN:
                rival = without_runs(with_runs(begun))
                break
        else:
            break
    return rival


def runs_to_begin_at(pose: PoseMode) -> list[np.ndarray]:
    """Closures of rejected runs that odometry alone predicts better than a believed run, the best predicted first."""
    told, right = pose.problem.told, pose.solved.places.right
    # Odometry tells nothing of closures between chains, for which there are other moves.
    could = told.is_known & (told.label == 0) & pose.problem.within_chain
    if not (could & (right < _WRONG)).any():
        return []
    alone = estimate_poses(pose.problem, ending=Ending(held_for=1))
    believed = run_discrepancies(alone, could & (right > _WRONG))
    rejected = run_discrepancies(alone, could & (right < _WRONG))
    worst = float(believed[np.isfinite(believed)].max(initial=0.0))
    order = (run for run in np.argsort(rejected, kind="stable") if rejected[run] < worst)
    members = (np.flatnonzero(could & (right < _WRONG) & (told.run == run)) for run in order)
    found = list(islice((each for each in members if could_be_right_together(alone, each)), _MAX_RUNS))
    return [*found, np.array([], dtype=np.int64)] if found else []


def could_be_right_together(pose: PoseMode, members: np.ndarray) -> bool:
    """Whether any two closures of a run ``(n,)`` contradict what predicts them by the same, up to their own errors.

    Random closures that are near each other do not: no two of them can both be right.
    """
    told, mean, k = pose.problem.told, pose.solved.predictions.mean, pose.problem.turns
    members = members[:MOST_MEMBERS]
    own = np.stack((told.rotation_variance, stated_variance(pose.problem, pose.state)), axis=1)[members]
    variance = np.repeat(own, [k, mean.shape[1] - k], axis=1)
    off = told.sign[members, None] * mean[members]
    one, other = np.triu_indices(len(members), 1)
    square = ((off[one] - off[other]) ** 2 / (variance[one] + variance[other])).sum(axis=1)
    return bool((square < _FAR**2 * mean.shape[1]).any())
