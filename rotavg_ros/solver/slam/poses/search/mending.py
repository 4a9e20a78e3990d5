"""Takes slips of odometry back that rotations and places together do not bear out.

Rotations alone may need slips to reconcile false closures that places know to be false. What all other rows predict of
a slipped segment tells whether it is likelier sound. If it is, or nearly, poses are estimated again with the segment
sound, and −log p decides, as between any two labellings.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import shift_covariance, turn_variances
from rotavg_ros.solver.slam.poses.rows import whitening
from rotavg_ros.solver.slam.poses.search.discrepancies import log_normal
from rotavg_ros.solver.slam.poses.search.settling import LEAST_GAIN, SLACK, Rival, settled
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.em import polish_fully
from rotavg_ros.solver.slam.posterior.labels.prior import log_slip_odds
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.state import State


def without_slips(rival: Rival) -> Rival:
    """The rival with slips taken back, one after the other, as long as −log p falls."""
    if rival.mode.problem.without & {"slips", "mending"}:
        return rival
    tried: set[bytes] = set()
    while True:
        gained, slipped = _gained_by_mending(rival.pose)
        for each in np.argsort(-gained, kind="stable"):
            sound = _sound(rival.pose.problem, slipped[[each]])
            if gained[each] < -SLACK or sound.trusted.tobytes() in tried:
                continue
            tried.add(sound.trusted.tobytes())
            mended = _estimated(rival.pose, sound)
            if mended.cost < rival.cost - LEAST_GAIN:
                rival = mended
                break
        else:
            return rival


def _gained_by_mending(pose: PoseMode) -> tuple[np.ndarray, np.ndarray]:
    """``(n,)`` predicted gains in nats if each slipped segment of the chain is sound, and these segments ``(n,)``.

    Of those that nobody has rejected.
    """
    problem, solved = pose.problem, pose.solved
    told = problem.mode.problem.log_odds[: problem.drawn.num_segments]
    slipped = np.flatnonzero(problem.slipped & np.isfinite(told))
    if len(slipped) == 0:
        return np.zeros(0), slipped
    back = np.linalg.inv(_whitening(problem, pose)[slipped])
    others, covariance = solved.factor.without(slipped)
    off = np.matmul(back, np.matmul(others, solved.left[slipped]))[:, :, 0]
    predicted = np.matmul(np.matmul(back, covariance), back.transpose(0, 2, 1))
    # For the densities alone: what is mended is estimated anew.
    mended = replace(problem, mode=replace(problem.mode, state=_sound(problem, slipped)))
    own = np.linalg.inv(_whitening(mended, pose)[slipped])
    if_sound, if_slipped = (
        log_normal(off, predicted + np.matmul(root, root.transpose(0, 2, 1))) for root in (own, back)
    )
    others_slipped = len(problem.mode.slipped) - 1
    odds = log_slip_odds(problem.mode.problem, problem.drawn.own_steps[slipped], others_slipped)
    return if_sound - if_slipped - odds, slipped


def _whitening(problem: PoseProblem, pose: PoseMode) -> np.ndarray:
    """``(E, d, d)`` roots of the rows' information, odometry's as a problem labels it."""
    solved, segments = pose.solved, slice(problem.drawn.num_segments)
    weight = solved.rotation_weight.copy()
    weight[segments] = 1 / turn_variances(problem, solved.state.noise)[segments]
    covariance = shift_covariance(problem, solved.state, solved.way)
    return whitening(problem, covariance, weight, solved.closure_root, solved.state)


def _sound(problem: PoseProblem, segments: np.ndarray) -> State:
    """The labelling's state with some segments ``(n,)`` sound, and not in the tails."""
    state = problem.mode.state
    trusted, relative = state.trusted.copy(), state.others.relative.copy()
    trusted[segments], relative[segments] = 1.0, 1.0
    return replace(state, trusted=trusted, others=replace(state.others, relative=relative))


def _estimated(pose: PoseMode, sound: State) -> Rival:
    before, state = pose.problem.mode, replace(sound, correction=pose.state.correction)
    mended = Mode(before.problem, *polish_fully(before.problem, state), before.origin)
    return settled(replace(pose.problem, mode=mended), PoseStart.at(pose))
