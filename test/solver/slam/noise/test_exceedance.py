"""How likely an uncertain rotation is to be large, against SciPy."""

from __future__ import annotations

import numpy as np
from scipy.stats import ncx2

from rotavg_ros.solver.slam.noise.exceedance import exceedance


def test_exceedance_is_the_noncentral_chi_distribution() -> None:
    length, sigma = np.radians([0.0, 5.0, 9.9, 30.0]), np.radians([1.0, 3.0, 8.0, 2.0])
    angle = np.radians(10.0)
    for components in (1, 3):
        expected = ncx2.sf((angle / sigma) ** 2, components, (length / sigma) ** 2)
        np.testing.assert_allclose(exceedance(length, sigma**2, angle, components), expected, atol=1e-7)
