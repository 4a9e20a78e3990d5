"""F(labels, θ) = −log p(labels, θ | data) in nats, with the corrections integrated out.

With r_e the residuals at the best corrections Ĉ and H the Hessian there,

    F = − Σ_sound log p(r_e | sound)  − Σ_slipped log p(r_e | slipped)  − Σ_good log p(r_e | good)  − Σ_runs log p(b)
        − log p(false closures)  − log p(labels)  − log p(θ)  + ½ k (log det H − d log 2π)

d is the number of unknowns: key nodes except the roots, and runs' common errors b. This is exact for normal densities;
those with tails are integrated by expectation propagation
(:class:`rotavg_ros.solver.slam.posterior.densities.Sites`). Where a gyroscope's bias or a sensor's mounting error was
removed, its − log p is added (:mod:`rotavg_ros.solver.slam.posterior.calibration`). Labellings are compared by F alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.posterior.densities import log_normal, log_slipped
from rotavg_ros.solver.slam.posterior.labels.false_closures import Discrepancies, false_density, log_false_set
from rotavg_ros.solver.slam.posterior.labels.prior import log_label_prior, log_slip_prior
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import residuals, sites, variances, weights, weights_if_good, with_others
from rotavg_ros.solver.slam.posterior.state import (
    COMMON_SHARES,
    EXPONENTS,
    RUN_STEPS,
    STEP_TAIL_RATIOS,
    TAIL_SHARES,
    TURN_SHARES,
    Noise,
    Others,
    State,
)
from rotavg_ros.solver.slam.posterior.system import Factorised

# Added to an F that is not valid yet, nats.
_UNKNOWN = 1e9


@dataclass(frozen=True)
class Evaluation:
    """F of a state and its parts.

    Attributes:
        terms: nats by name.
        residual: ``(E + R, 3)`` rad, of all rows.
        weight: ``(E + R,)`` rad⁻².
        factorised: H.
        others: prediction of each edge by all others.
        is_moving: whether corrections were not at their optimum yet, so that F is meaningless.
    """

    terms: dict[str, float]
    residual: np.ndarray
    weight: np.ndarray
    factorised: Factorised
    others: Others
    is_moving: bool = False

    @property
    def total(self) -> float:
        """F, nats; larger than any other while corrections still move."""
        return sum(self.terms.values()) + self.is_moving * _UNKNOWN


def evaluate(problem: Problem, state: State, *, is_moving: bool = False) -> Evaluation:
    """F where corrections are at their optimum; labels are rounded.

    Args:
        problem: the graph.
        state: the state to evaluate.
        is_moving: whether corrections have not reached their optimum.
    """
    graph, priors, k = problem.graph, problem.priors, problem.components
    state = replace(state, trusted=state.is_good.astype(np.float64))
    variance, residual = variances(problem, state.noise), residuals(problem, state)
    system = problem.system(state.noise)
    num_edges, good = len(graph.source), state.is_good
    own, common = np.split(variance, [num_edges])
    if_good = weights_if_good(state, own, sites(problem, state, residual, variance))
    factorised = system.factorise(weights(problem, state, if_good, variance))
    told = with_others(state, factorised, if_good, own, k)
    site = sites(problem, told, residual, variance)
    weight, square = factorised.weight, (residual**2).sum(axis=1)
    # The normal density that approximates each, and the log ratio of its own density's evidence to the approximation's.
    log_if_good = log_normal(square[:num_edges], 1 / weight[:num_edges], k) + site.log_density
    log_if_good -= log_normal(site.square, 1 / weight[:num_edges] + site.predicted, k)
    slipped = np.flatnonzero(graph.is_odometry & ~good)
    log_if_slipped = log_slipped(square[slipped], own[slipped], 0.0, k, priors)
    is_false = ~good[problem.closure]
    false = false_density(problem, is_false, Discrepancies.of(problem, told, residual), np.flatnonzero(is_false))
    unknowns = system.size - len(graph.roots)
    terms = {
        "odometry": -float(log_if_good[graph.is_odometry & good].sum()),
        "slips": -float(log_if_slipped.sum()) - log_slip_prior(problem, slipped),
        "good closures": -float(log_if_good[graph.is_closure & good].sum()),
        "common errors": -float(log_normal(square[num_edges:], common, k).sum()),
        "false closures": -log_false_set(problem, false),
        "labels": -log_label_prior(problem, is_false),
        "noise": -log_noise_prior(state.noise, priors),
        "orientations": k / 2 * (factorised.log_det - unknowns * np.log(2 * np.pi)),
    }
    if problem.calibrated is not None:
        information, _ = problem.calibrated.information(graph.source, state, residual, factorised, priors)
        terms["calibration"] = problem.calibrated.cost(information, priors)
    return Evaluation(terms, residual, weight, factorised, told.others, is_moving)


def log_noise_prior(noise: Noise, priors: SlamPriors) -> float:
    """Log prior of θ: both standard deviations log-normal; a probability that each grid stays at 0, others uniform."""
    step = np.log(noise.step_variance) / 2 - np.log(np.radians(priors.step_deg))
    closure = np.log(noise.closure_variance) / 2 - np.log(np.radians(priors.closure_deg))
    some = priors.stated_share / (len(EXPONENTS) - 1)
    believed = np.log(some if noise.exponent > 0 else 1 - priors.stated_share)
    some = priors.common_errors / (len(COMMON_SHARES) * (len(RUN_STEPS) - 1))
    common = np.log(some if noise.run_steps > 0 else 1 - priors.common_errors)
    some = priors.turn_errors / (len(TURN_SHARES) - 1)
    turns = np.log(some if noise.turn_share > 0 else 1 - priors.turn_errors)
    some = priors.tails / (len(TAIL_SHARES) - 1)
    tailed = np.log(some if noise.closure_tails > 0 else 1 - priors.tails)
    tailed += np.log(some / len(STEP_TAIL_RATIOS) if noise.step_tails > 0 else 1 - priors.tails)
    beside = np.log(noise.beside) / 2
    squares = step**2 + closure**2 + beside**2
    return float(believed + common + turns + tailed - squares / (2 * priors.noise_spread**2))
