"""A point of the search: orientations, common errors, labels and noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Grids from which F chooses α, κ and the length of runs, in steps of odometry; with length 0, closures err
# independently. Alternatives of nearly the same F are averaged when published.
EXPONENTS = (0.0, 0.5, 1.0)
COMMON_SHARES = (0.15, 0.3, 0.6, 0.85)
RUN_STEPS = (0.0, 20.0, 60.0)
# … and over the share of odometry's variance that is proportional to its squared turns: at most half, since with more
# F falls on B25b while its error grows.
TURN_SHARES = (0.0, 0.5)
# … and over the share of edges of a kind in its tails, and the factor of the variance in odometry's tails: from a
# slightly uneven floor to a bump.
TAIL_SHARES = (0.0, 0.02, 0.1, 0.3)
STEP_TAIL_RATIOS = (16.0, 64.0, 256.0)


@dataclass(frozen=True)
class Noise:
    """θ.

    Attributes:
        step_variance: rad² per component, of one step of odometry.
        closure_variance: rad² per component, of a good closure whose stated variance is typical.
        exponent: α, how far the ratios of stated variances are believed.
        common_share: κ, share of a closure's error variance that its run has in common.
        turn_share: share of odometry's variance proportional to the squared turns of its steps, not to their number.
        step_tails, closure_tails: share of sound segments, and of good closures, that err by far more than others.
        step_tail_ratio: τ, variance of these segments relative to the others.
        step_told: φ, k_eff / k of odometry, 1 where it errs alike about all axes (estimated with the variances).
        beside: variance of odometry beside the chain, relative to the chain's over as many steps (likewise).
        run_steps: largest length of a run at its older end, in steps of odometry; 0 where closures err independently.
    """

    step_variance: float
    closure_variance: float
    exponent: float
    common_share: float
    run_steps: float
    turn_share: float = 0.0
    step_tails: float = TAIL_SHARES[0]
    closure_tails: float = TAIL_SHARES[0]
    step_tail_ratio: float = STEP_TAIL_RATIOS[0]
    step_told: float = 1.0
    beside: float = 1.0

    @property
    def is_possible(self) -> bool:
        """Whether the values are valid, for noise read from a file."""
        variances = self.step_variance, self.closure_variance, self.step_tail_ratio, self.step_told, self.beside
        shares = self.common_share, self.turn_share, self.step_tails, self.closure_tails
        return min(variances) > 0 and max(shares) < 1

    def chosen_as(self, other: Noise) -> Noise:
        """The own values that are estimated from residuals, with another noise's values that are chosen from grids."""
        told = {name: getattr(self, name) for name in ("step_variance", "closure_variance", "step_told", "beside")}
        return replace(other, **told)

    @property
    def log_ratio(self) -> float:
        """Logarithm of a step's variance over a closure's: how far odometry yields before closures do."""
        return float(np.log(self.step_variance / self.closure_variance))

    @property
    def chosen(self) -> tuple[float, ...]:
        """Values chosen from grids: α, κ, the length of runs, the share that goes with turns, and tails."""
        return (
            self.exponent,
            self.common_share,
            self.run_steps,
            self.turn_share,
            self.step_tails,
            self.closure_tails,
            self.step_tail_ratio,
        )


@dataclass(frozen=True)
class Others:
    """Prediction of each edge's residual by all others (E edges).

    Attributes:
        rest: ``(E,)`` residual after the solve over the discrepancy with that prediction, 1 − w R.
        predicted: ``(E,)`` rad², variance of the prediction.
        relative: ``(E,)`` the edge's weight as a good one, times its variance.
    """

    rest: np.ndarray
    predicted: np.ndarray
    relative: np.ndarray

    @classmethod
    def before_any(cls, num_edges: int) -> Others:
        """Before any solve: residuals are the discrepancies, and all noise is normal."""
        return cls(np.ones(num_edges), np.zeros(num_edges), np.ones(num_edges))


@dataclass(frozen=True)
class State:
    """A state of a problem (K key nodes, R runs, E edges).

    Attributes:
        correction: ``(4, K)`` C, world-frame corrections of the odometry's orientations.
        common: ``(R, 3)`` common errors of runs, rad.
        trusted: ``(E,)`` 1 for good closures and sound segments, 0 for others; in between while labels are
            probabilities.
        noise: θ.
        others: prediction of each edge by all others in the last solve.
    """

    correction: np.ndarray
    common: np.ndarray
    trusted: np.ndarray
    noise: Noise
    others: Others

    @property
    def is_good(self) -> np.ndarray:
        """``(E,)`` bool."""
        return self.trusted > 0.5
