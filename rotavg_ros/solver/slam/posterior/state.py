"""A point of the search: orientations, common errors, labels and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Nodes of the sums that stand for integrals over α, κ and the length of runs, in steps of odometry; with 0 closures err
# independently.
EXPONENTS = (0.0, 0.5, 1.0)
COMMON_SHARES = (0.15, 0.3, 0.6, 0.85)
RUN_STEPS = (0.0, 20.0, 60.0)
# … and over the share of odometry's variance that goes with how far it turns: half at most, since with
# more F falls on B25b while its error grows.
TURN_SHARES = (0.0, 0.5)


@dataclass(frozen=True)
class Noise:
    """θ.

    Attributes:
        step_variance: rad² per component, of one step of odometry.
        closure_variance: rad² per component, of a good closure that states what is typical.
        exponent: α, how far the ratios of stated variances are believed.
        common_share: κ, share of a closure's error variance that its run has in common.
        turn_share: share of odometry's variance that goes with the squares of the turns of its steps, not their number.
        run_steps: no run is longer at its older end, in steps of odometry; 0 where closures err independently.
    """

    step_variance: float
    closure_variance: float
    exponent: float
    common_share: float
    run_steps: float
    turn_share: float = 0.0

    @property
    def log_ratio(self) -> float:
        """Logarithm of a step's variance over a closure's: how far odometry bends before closures do."""
        return float(np.log(self.step_variance / self.closure_variance))

    @property
    def chosen(self) -> tuple[float, ...]:
        """What is chosen from grids: α, κ, the length of runs and the share that goes with turns."""
        return self.exponent, self.common_share, self.run_steps, self.turn_share


@dataclass(frozen=True)
class State:
    """Of a problem (K key nodes, R runs, E edges).

    Attributes:
        correction: ``(4, K)`` C, world-frame corrections of the odometry's orientations.
        common: ``(R, 3)`` common errors of runs, rad.
        trusted: ``(E,)`` 1 for good closures and sound segments, 0 for others; between while labels are probabilities.
        noise: θ.
    """

    correction: np.ndarray
    common: np.ndarray
    trusted: np.ndarray
    noise: Noise

    @property
    def is_good(self) -> np.ndarray:
        """``(E,)`` bool."""
        return self.trusted > 0.5
