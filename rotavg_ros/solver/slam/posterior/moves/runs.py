"""Moves that reject a whole run: good closures that support each other although all other edges contradict them.

For K closures of a run with residuals r, weights V⁻¹ in the solve (diagonal; less than the inverse variance where a
closure is in the tails) and covariance R of their fitted values, all other edges predict their discrepancies y as
N(0, S):

    y = V (V − R)⁻¹ r,    S = V (V − R)⁻¹ V.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import cho_solve

from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves.slips import SETTLING, log_labelled
from rotavg_ros.solver.slam.posterior.rows import variances
from rotavg_ros.solver.slam.posterior.state import State

# Least number of good closures in a run.
_LEAST_MEMBERS = 2


def propose_rejected_runs(mode: Mode) -> Iterator[Proposal]:
    """Proposes to reject runs of good closures: of a large common residual, or that all other edges hardly support."""
    problem, limits = mode.problem, mode.problem.limits
    runs = _runs(mode)
    if not runs:
        return
    residual = mode.evaluation.residual[problem.closure]
    before = log_labelled(mode, mode.is_false, residual)
    for members, log_density, off in runs:
        is_false, discrepancy = mode.is_false.copy(), residual.copy()
        is_false[members], discrepancy[members] = True, off
        predicted = before + log_density - log_labelled(mode, is_false, discrepancy)
        # A run that alone holds a part turns it, and the map without it may be a rival though it is less likely.
        turned = float(np.linalg.norm((off * problem.sign[members, None]).mean(axis=0)))
        slack = limits.rival if mode.is_turned_by(turned) else limits.slack
        yield Proposal("reject a run", predicted, partial(_rejected, mode, members), slack)


def _runs(mode: Mode) -> list[tuple[np.ndarray, float, np.ndarray]]:
    """Good closures ``(K,)`` of runs, with what all other edges say of them (:func:`_without`).

    First the runs whose summed residual is the most standard deviations. Then, unless there are too many closures, the
    others that all else supports least: those of the lowest density, in units of what their closures themselves allow.
    """
    problem, is_good = mode.problem, ~mode.is_false & ~np.isinf(mode.problem.log_odds[mode.problem.closure])
    own = variances(problem, mode.state.noise)[problem.closure]
    off = mode.evaluation.residual[problem.closure] * (problem.sign * is_good)[:, None]
    total = np.stack([np.bincount(problem.run, column) for column in off.T], axis=1)
    square = (total**2).sum(axis=1) / np.maximum(np.bincount(problem.run, own * is_good), np.finfo(np.float64).tiny)
    order = np.argsort(-square, kind="stable")
    chosen = order[np.bincount(problem.run, is_good)[order] >= _LEAST_MEMBERS]
    most = problem.limits.candidates
    found: list[tuple[float, tuple[np.ndarray, float, np.ndarray]]] = []
    for run in chosen if mode.covariance_is_cheap else chosen[:most]:
        members = np.flatnonzero(is_good & (problem.run == run))
        if (told := _without(mode, members)) is not None:
            support = told[0] + problem.components / 2 * float(np.log(own[members]).sum())
            found.append((support, (members, *told)))
    others = sorted(found[most:], key=lambda each: each[0])[:most]
    return [run for _, run in (*found[:most], *others)]


def _without(mode: Mode, members: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Log density of K closures as all other edges predict them, and their discrepancies ``(K, 3)`` rad.

    None if the other edges do not determine the prediction.
    """
    problem, k = mode.problem, mode.problem.components
    rows, sign = problem.closure[members], problem.sign[members, None]
    own = 1 / mode.evaluation.weight[rows]
    left = np.diag(own) - mode.covariance_of(members) * sign * sign.T
    try:
        factor = np.linalg.cholesky(left)
    except np.linalg.LinAlgError:
        return None
    # If members alone join two parts, rounding may still allow a factor; its discrepancies then exceed any rotation.
    log_det_left = 2 * float(np.log(np.diagonal(factor)).sum())
    residual = mode.evaluation.residual[rows] * sign
    solved = cho_solve((factor, True), residual)
    off = own[:, None] * solved
    if not (np.abs(off) < np.pi).all():
        return None
    log_det = 2 * float(np.log(own).sum()) - log_det_left
    log_density = -float((residual * solved).sum()) / 2 - k / 2 * (log_det + len(rows) * np.log(2 * np.pi))
    return log_density, off * sign


def _rejected(mode: Mode, members: np.ndarray) -> State:
    trusted = mode.state.trusted.copy()
    trusted[mode.problem.closure[members]] = 0.0
    return settle(mode.problem, replace(mode.state, trusted=trusted), SETTLING)
