"""How a SLAM closure is judged by all the others, and what the residuals say of the noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import expit

from rotavg_ros.solver.slam.noise.exceedance import exceedance
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG

OUTLIER_ANGLE = np.radians(FALSE_CLOSURE_DEG)
# Redundancy below this many edges' worth says little about a variance; the estimate so far is worth as much.
_PRIOR_ODOMETRY_REDUNDANCY = 5.0
_PRIOR_CLOSURE_SQUARE = np.radians(0.08) ** 2
# This share of the good closures errs more than the others, and of what the rest predicts of them, by so many times the
# variance; less where that would look like a false one. Else a closure that alone ties a long loop is called false for
# an error of a degree, or for odometry that did not drift evenly.
TAIL_SHARE = 0.1
TAIL_RATIO = 16.0
_MAX_TAIL_VARIANCE = np.radians(1.5) ** 2
_MAX_PREDICTED_TAIL_VARIANCE = np.radians(3.0) ** 2


class Judgement(NamedTuple):
    """Of E edges.

    Attributes:
        log_odds: ``(E,)`` of being good.
        exact_share: ``(E,)`` probability of a good one to err no more than most; None if closures are too noisy.
    """

    log_odds: np.ndarray
    exact_share: np.ndarray | None


def judge(
    noise: NoiseModel, square: np.ndarray, variance: np.ndarray, prediction_variance: np.ndarray, ratio: np.ndarray
) -> Judgement:
    """Log-odds of edges to be good, by how far they are from what the rest of the graph predicts of them.

    The alternative is the noise model's false component, uniform over all rotations. The common share of false edges is
    in the log-odds. What the network says of each edge is not: ``Passes.one_pass`` adds it, and the logistic function
    of the sum is p_e, a factor of the edge's weight. No edge is switched off.

    Args:
        square: ``(E,)`` rad², of the leave-one-out discrepancies.
        variance: ``(E,)`` rad², of the edges' own noise if they are good.
        prediction_variance: ``(E,)`` rad², of the predictions.
        ratio: ``(E,)`` of :func:`tail_ratio`.
    """
    log_odds = noise.inlier_log_odds(square, variance + prediction_variance)
    exact_share = None
    if (ratio > 1).any():
        bound = np.maximum(_MAX_PREDICTED_TAIL_VARIANCE, prediction_variance)
        tail_variance = ratio * variance + np.minimum(ratio * prediction_variance, bound)
        exact = log_odds + np.log1p(-TAIL_SHARE)
        inexact = noise.inlier_log_odds(square, tail_variance) + np.log(TAIL_SHARE)
        log_odds, exact_share = np.logaddexp(exact, inexact), expit(exact - inexact)
    return Judgement(log_odds + noise.prior_log_odds, exact_share)


def exactness_of(exact_share: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """What good edges weigh ``(E,)``, those that err no more than most being 1."""
    return np.asarray(exact_share + (1 - exact_share) / ratio)


def tail_ratio(variance: np.ndarray) -> np.ndarray:
    """By how much larger the variance of the worse ones among good closures is than that of most, ``(E,)`` rad²."""
    return np.asarray(np.clip(_MAX_TAIL_VARIANCE / variance, 1.0, TAIL_RATIO))


def estimated_step_variance(square: np.ndarray, redundancy: np.ndarray, noise: NoiseModel) -> float:
    """Of the odometry, rad² per step: residuals' squares ``(S,)`` over the redundancies ``(S,)`` that they leave."""
    prior = _PRIOR_ODOMETRY_REDUNDANCY * noise.components
    total = float(square.sum()) + prior * noise.step_variance
    return float(total / (float(redundancy.sum()) * noise.components + prior))


def estimated_closure_variance(
    square: np.ndarray, probability: np.ndarray, redundancy: np.ndarray, noise: NoiseModel
) -> float:
    """Of the closures, rad², likewise; ``(C,)`` each."""
    total = float((probability * square).sum()) + _PRIOR_CLOSURE_SQUARE
    return float(total / (float(redundancy.sum()) * noise.components + 1))


def outlier_probability(
    inlier_probability: np.ndarray,
    discrepancy: np.ndarray,
    variance: np.ndarray,
    prediction_variance: np.ndarray,
    components: int,
) -> np.ndarray:
    """That a closure's true noise exceeds :data:`OUTLIER_ANGLE`, ``(E,)``.

    A discrepancy is a closure's noise and the prediction's error. Noise of a good closure is known beforehand to be
    Gaussian; a false one's can be anything, so that the discrepancy alone says what it is.

    Args:
        inlier_probability: ``(E,)`` that it is not a false one.
        discrepancy: ``(E,)`` rad, leave-one-out.
        variance: ``(E,)`` rad², of its own noise if it is not.
        prediction_variance: ``(E,)`` rad², of what the rest of the graph predicts.
    """
    own = variance / (variance + prediction_variance)
    if_good = exceedance(own * discrepancy, own * prediction_variance, OUTLIER_ANGLE, components)
    if_false = exceedance(discrepancy, prediction_variance, OUTLIER_ANGLE, components)
    return np.asarray(inlier_probability * if_good + (1 - inlier_probability) * if_false)
