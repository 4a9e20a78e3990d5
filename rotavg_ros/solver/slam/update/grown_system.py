"""The system of the passes on a graph that has grown by a few edges, solved from an older factorisation."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.passes.system import StaleFactorError
from rotavg_ros.solver.slam.update.grown_laplacian import GrownLaplacian


class GrownSystem:
    """Solved from an older factorisation; predictions are as they were, and exact of closures that came since.

    Attributes:
        laplacian: the system.
    """

    def __init__(self, laplacian: GrownLaplacian, prediction_variance: np.ndarray) -> None:
        """Take the predictions' variances ``(E,)`` as they are known; those of new closures are not looked at."""
        self.laplacian = laplacian
        self.prediction_variance = prediction_variance

    def solve(self, weight: np.ndarray, residual: np.ndarray, *, refresh: bool, is_near: bool) -> np.ndarray:
        """See :class:`System`."""
        self.laplacian.reweight(weight)
        step = self.laplacian.fit(residual)
        if step is None:
            raise StaleFactorError
        return step

    def predict(self, weight: np.ndarray) -> None:
        """See :class:`System`."""
        variance = self.prediction_variance.copy()
        variance[self.laplacian.closures] = self.laplacian.prediction_variance()
        self.prediction_variance = variance
