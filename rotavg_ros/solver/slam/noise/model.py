"""The noise of a SLAM graph: Gaussian odometry steps and closures, and closures that are entirely wrong.

An inlier's discrepancy with another estimate is Gaussian in k components (k = 1 where all rotations share an axis, else
3); a false closure is uniform over all rotations. Stated precisions are often nonsense, so both variances are
estimated. The first estimate is by expectation–maximisation over the closures' discrepancies against odometry: these
grow with the number of steps passed, while the closures' own noise does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.noise.mixture import Discrepancies, MixtureFit, Mixtures, log_uniform_density

# rad², assumed where there are no data to estimate from.
_PRIOR_STEP_VARIANCE = np.radians(0.3) ** 2
_PRIOR_CLOSURE_VARIANCE = np.radians(2.0) ** 2
# Neighbours determine the noise of good closures, but not how many are false.
_NEIGHBOURS_OUTLIER_SHARE = 0.3
_EM_STARTS_STEP_DEG = (0.02, 0.1, 0.5, 2.0)
# By components: about one axis, closures with noise of 8° are hard to tell from random ones, and the odometry decides.
_EM_STARTS_CLOSURE_DEG = {1: (0.3, 2.0), 3: (0.3, 2.0, 8.0)}
# False share of the odometry's discrepancies and of the neighbours' to start from.
_EM_START_SHARES = (0.5, 0.7)
# Share of false closures that are assumed to be near misses, off by 10–30°, as where the same place is seen from
# elsewhere. With a share of 0, a graph with many of them would seem to have closures that all err by 8°, and odometry
# that does not err at all.
_NEAR_MISS_SHARE = 0.2
# Rows of either kind used to choose among the starts, and to converge.
_EM_THINNED = (1000, 5000)
# Rounds: number of starts that are kept, after a number of iterations of each.
_EM_ROUNDS = ((3, 4), (1, 4))
_EM_MAX_STEPS = 60
# The likelihood hardly determines a small graph's drift, and closures with errors in the tails look like drift. Of the
# step variances that are less likely by at most this, nats, the least is taken, down to a share of the likeliest one.
# Odometry that is trusted too much costs a few good closures until more of them come; a false closure that is believed
# bends the map.
_STEP_DOUBT = 5.0
_STEP_DOUBT_SHARES = np.array([0.85, 0.7, 0.55, 0.47, 0.4]) ** 2
_DOUBT_ITERATIONS = 8


@dataclass(frozen=True)
class NoiseModel:
    """Variances are of one component of the rotation vector, in rad².

    Attributes:
        components: k, 1 for planar motion, else 3.
        step_variance: of one odometry edge.
        closure_variance: of a good loop closure.
        outlier_share: share of the closures that are false.
    """

    components: int
    step_variance: float
    closure_variance: float
    outlier_share: float

    def inlier_log_odds(self, squared_angle: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Log-odds of good against false, without the prior, for discrepancies of given total variance.

        Args:
            squared_angle: ``(E,)`` rad².
            variance: ``(E,)`` rad² per component.
        """
        gaussian = -squared_angle / (2 * variance) - self.components / 2 * np.log(2 * np.pi * variance)
        return np.asarray(gaussian - log_uniform_density(np.sqrt(squared_angle), self.components))

    @property
    def prior_log_odds(self) -> float:
        """Prior log-odds of good against false."""
        return float(np.log1p(-self.outlier_share) - np.log(self.outlier_share))


def pair_variance(pairs: AgreementPairs, noise: NoiseModel) -> np.ndarray:
    """Variance of the difference of two good neighbouring closures' residuals, ``(P,)`` rad² per component."""
    return np.asarray(np.maximum(pairs.steps, 0.5) * noise.step_variance + 2 * noise.closure_variance)


def agree(pairs: AgreementPairs, noise: NoiseModel) -> np.ndarray:
    """``(P,)`` bool, pairs that differ by so little that they are more likely both good than random."""
    return noise.inlier_log_odds(pairs.squared_angle, pair_variance(pairs, noise)) > 0


def discrepancies(
    squared_angle: np.ndarray, path_steps: np.ndarray, pairs: AgreementPairs, near_share: float = _NEAR_MISS_SHARE
) -> list[Discrepancies]:
    """Discrepancies of every closure with the odometry (``(C,)`` each; infinite steps: none), and between neighbours.

    Args:
        near_share: share of the false closures that are near misses, for discrepancies between neighbours. Odometry
            drifts by as much, so it cannot tell them.
    """
    on_chain = np.isfinite(path_steps)
    # Every closure has equally many pairs, which together count as one.
    per_closure = len(pairs.first) / max(len(np.unique(pairs.first)), 1)
    return [
        Discrepancies(squared_angle[on_chain], np.maximum(path_steps[on_chain], 1.0), 1, 1.0),
        Discrepancies(pairs.squared_angle, np.maximum(pairs.steps, 0.5), 2, 1 / max(per_closure, 1.0), near_share),
    ]


def estimate_noise(data: Sequence[Discrepancies], components: int) -> NoiseModel:
    """Two variances and an outlier share by expectation–maximisation from several starts; the likeliest is kept.

    The step variance is the lower end of those that are nearly as likely.

    A discrepancy is Gaussian with variance ``steps · step_variance + closures · closure_variance`` or uniform. The
    closures' agreement with each other keeps the estimate sound where odometry has drifted too far or most closures are
    false; their discrepancy with the chain separates the two variances.

    Args:
        data: discrepancies of closures with the odometry, and between neighbouring closures.
        components: k.
    """
    few = MixtureFit([kind.thinned(_EM_THINNED[0]) for kind in data], components)
    likeliest = _likeliest(data, few, components)
    if likeliest is None:
        return _prior(components)
    return _model(_least_drift(few, likeliest), components)


def likeliest_by_chain(data: Discrepancies, components: int) -> tuple[NoiseModel, float]:
    """The likeliest noise by discrepancies with odometry alone; its log-likelihood less that if all are false, nats."""
    kinds = [data, Discrepancies(np.empty(0), np.empty(0), 2, 1.0)]
    likeliest = _likeliest(kinds, MixtureFit([kind.thinned(_EM_THINNED[0]) for kind in kinds], components), components)
    if likeliest is None:
        return _prior(components), 0.0
    fit = MixtureFit(kinds, components)
    return _model(likeliest, components), float(fit.step(likeliest)[1][0]) - fit.log_likelihood_if_false


def _prior(components: int) -> NoiseModel:
    return NoiseModel(components, _PRIOR_STEP_VARIANCE, _PRIOR_CLOSURE_VARIANCE, 0.25)


def _model(mixture: Mixtures, components: int) -> NoiseModel:
    """The noise model of the first of some mixtures."""
    values = (mixture.step_variance[0], mixture.closure_variance[0], mixture.false_share[0, 0])
    return NoiseModel(components, *(float(value) for value in values))


def _likeliest(data: Sequence[Discrepancies], few: MixtureFit, components: int) -> Mixtures | None:
    """The likeliest of all models; starts are chosen by a ``few`` of the data. None without data."""
    if not any(len(kind.steps) for kind in data):
        return None
    starts = np.radians(list(product(_EM_STARTS_STEP_DEG, _EM_STARTS_CLOSURE_DEG[components]))) ** 2
    models = Mixtures(starts[:, 0], starts[:, 1], np.tile(_EM_START_SHARES, (len(starts), 1)))
    for survivors, iterations in _EM_ROUNDS:
        models, log_likelihood = few.maximise(models, iterations)
        models = models.best(log_likelihood, survivors)
    return MixtureFit([kind.thinned(_EM_THINNED[1]) for kind in data], components).converge(models, _EM_MAX_STEPS)


def noise_between_neighbours(pairs: AgreementPairs, components: int) -> NoiseModel:
    """The noise by neighbouring closures alone: long odometry has no influence, so slips have none."""
    data = discrepancies(np.empty(0), np.empty(0), pairs, 0.0)
    likeliest = _likeliest(data, MixtureFit([kind.thinned(_EM_THINNED[0]) for kind in data], components), components)
    model = _prior(components) if likeliest is None else _model(likeliest, components)
    # Where few closures share their ends, odometry's variance absorbs theirs; but no closure is better than a step.
    closure_variance = max(model.closure_variance, model.step_variance)
    return replace(model, closure_variance=closure_variance, outlier_share=_NEIGHBOURS_OUTLIER_SHARE)


def _least_drift(data: MixtureFit, likeliest: Mixtures) -> Mixtures:
    """The model of least step variance that is nearly as likely as the likeliest."""
    model, log_likelihood = data.maximise(likeliest, _DOUBT_ITERATIONS, hold_step=True)
    least, highest = likeliest, log_likelihood[0]
    for share in _STEP_DOUBT_SHARES:
        start = model._replace(step_variance=share * likeliest.step_variance)
        model, log_likelihood = data.maximise(start, _DOUBT_ITERATIONS, hold_step=True)
        highest = max(highest, log_likelihood[0])
        if log_likelihood[0] < highest - _STEP_DOUBT:
            break
        least = model
    return least


def judge_by_chain(model: NoiseModel, squared_angle: np.ndarray, path_steps: np.ndarray) -> np.ndarray:
    """Log-odds that each closure is good, from its discrepancy with the odometry alone, without a prior."""
    finite = np.isfinite(path_steps)
    variance = np.where(finite, path_steps, 0.0) * model.step_variance + model.closure_variance
    return np.where(finite, model.inlier_log_odds(squared_angle, variance), 0.0)
