"""Reject or believe a group of closures at once, by its joint leave-one-out evidence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.labels import false_density, log_label_prior, repeat_rates
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import variances
from rotavg_ros.solver.slam.posterior.state import State

# Closures of a group agree to so many standard deviations.
_AGREE = 3.0
_SETTLING = 3
# Groups that agree to half of that are looked at, too.
_TIGHTER = 0.25


def propose(mode: Mode) -> Iterator[Proposal]:
    """Groups whose flip is predicted to lower F, or nearly so."""
    problem = mode.problem
    closure = problem.closure
    before = log_label_prior(problem, mode.is_false)
    at = mode.evaluation.residual[closure]
    rates = repeat_rates(problem, false_density(problem, mode.is_false, at, np.flatnonzero(mode.is_false)))
    for members in candidates(mode):
        rejects = not mode.is_false[members[0]]
        log_good, residual = _evidence(mode, members, rejects)
        is_false = mode.is_false.copy()
        is_false[members] = True
        residuals = at.copy()
        residuals[members] = residual
        # Given all other false closures; those after them gain as much as those before.
        density = false_density(problem, is_false, residuals, members).mixed().sum(axis=1)
        log_false = float(np.logaddexp.reduce(density + rates))
        is_false[members] = rejects
        log_prior = log_label_prior(problem, is_false) - before
        predicted = (log_good - log_false if rejects else log_false - log_good) - log_prior
        name = "reject a group" if rejects else "believe a group"
        make = partial(_flipped, problem, mode.state, members, rejects)
        yield Proposal(name, predicted, make, problem.limits.slack)


def _flipped(problem: Problem, state: State, members: np.ndarray, rejects: bool) -> State:
    trusted = state.trusted.copy()
    trusted[problem.closure[members]] = 0.0 if rejects else 1.0
    flipped = replace(state, trusted=trusted)
    return flipped if rejects else settle(problem, flipped, _SETTLING)


def candidates(mode: Mode) -> list[np.ndarray]:
    """Groups of two and more closures of one label: by place, and by time as long as their residuals agree."""
    problem = mode.problem
    found: dict[bytes, np.ndarray] = {}
    for false in (False, True):
        members = problem.detection[mode.is_false[problem.detection] == false]
        if len(members) < 2:
            continue
        labels = [_by_place(problem, mode.is_false == false)[members]]
        labels += [np.cumsum(_breaks(mode, members, tighter)) for tighter in (1.0, _TIGHTER)]
        for label in labels:
            order = np.argsort(label, kind="stable")
            for group in np.split(members[order], np.flatnonzero(np.diff(label[order])) + 1):
                if len(group) >= 2:
                    group = np.sort(group)
                    found.setdefault(group.tobytes(), group)
    residual = mode.evaluation.residual[problem.closure]
    weight = mode.evaluation.weight[problem.closure]

    def strain(group: np.ndarray) -> float:
        return -float((weight[group] * (residual[group] ** 2).sum(axis=1)).sum() / len(group))

    count = problem.limits.groups
    rejected = [group for group in found.values() if mode.is_false[group[0]]]
    believed = sorted((group for group in found.values() if not mode.is_false[group[0]]), key=strain)
    return believed[:count] + sorted(rejected, key=len, reverse=True)[:count]


def _by_place(problem: Problem, chosen: np.ndarray) -> np.ndarray:
    """``(C,)`` a number for each chain of chosen closures that follow each other."""
    linked = np.flatnonzero(chosen & (problem.follows >= 0))
    linked = linked[chosen[problem.follows[linked]]]
    links = coo_array((np.ones(len(linked)), (linked, problem.follows[linked])), shape=(len(chosen),) * 2)
    return np.asarray(connected_components(links, directed=False)[1])


def _breaks(mode: Mode, members: np.ndarray, tighter: float) -> np.ndarray:
    """``(n,)`` bool, where closures, as they were detected, no longer agree with the one before."""
    problem = mode.problem
    residual = (mode.evaluation.residual[problem.closure] * problem.sign[:, None])[members]
    distance = (np.diff(residual, axis=0) ** 2).sum(axis=1)
    variance = 2 * problem.components * mode.state.noise.closure_variance
    is_far = np.abs(np.diff(problem.ends[members, 1])) > problem.priors.run_gap_steps
    return np.append(True, is_far | (distance > tighter * _AGREE**2 * variance))


def _evidence(mode: Mode, members: np.ndarray, believed: bool) -> tuple[float, np.ndarray]:
    """Log density of a group's residuals if good, given the rest, and what its residuals are without it."""
    problem, k = mode.problem, mode.problem.components
    rows = problem.closure[members]
    residual = mode.evaluation.residual[rows]
    covariance = mode.covariance_of(members)
    if believed:
        weight = mode.evaluation.weight[rows]
        left = np.eye(len(rows)) - covariance * weight
        without = np.linalg.solve(left, residual)
        square = float((residual * weight[:, None] * without).sum())
        log_det = -float(np.linalg.slogdet(left)[1]) - float(np.log(weight).sum())
    else:
        total = covariance + np.diag(variances(problem, mode.state.noise)[rows])
        without = residual
        square = float((residual * np.linalg.solve(total, residual)).sum())
        log_det = float(np.linalg.slogdet(total)[1])
    return -square / 2 - k / 2 * (log_det + len(rows) * np.log(2 * np.pi)), without
