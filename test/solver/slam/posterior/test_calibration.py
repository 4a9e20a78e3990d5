"""A bias's share of F against the dense integral."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.posterior.em import polish

from .planar import GAUSSIAN_PRIORS, log_evidence, planar, problem_of, state_of


@pytest.mark.parametrize(("seed", "planted_deg"), [(0, 0.0), (1, 0.05), (2, -0.3), (3, 1.0)])
def test_a_bias_has_the_evidence_of_a_dense_integral(seed: int, planted_deg: float) -> None:
    graph, _ = planar(seed, 8, 0.0, length=40)
    graph = without_bias(graph, np.radians([0.0, 0.0, -planted_deg]))
    good = np.zeros(8, dtype=bool)
    plain = problem_of(graph)
    _, before = polish(plain, state_of(plain, good), hold_noise=True)
    rate, totals = 0.0, []
    for _ in range(3):
        problem = problem_of(graph, rate=rate)
        state, after = polish(problem, state_of(problem, good), hold_noise=True)
        assert problem.calibrated is not None
        information, change = problem.calibrated.information(
            problem.graph.source, state, after.residual, after.factorised, GAUSSIAN_PRIORS
        )
        # What F falls by until the likeliest bias is known from wherever it is looked for.
        totals.append(after.total - float(change @ information @ change) / 2)
        rate += float((change @ problem.calibrated.axes)[2])
    densely = log_evidence(plain, good, GAUSSIAN_PRIORS.bias_deg) - log_evidence(plain, good)
    assert before.total - totals[-1] == pytest.approx(densely, abs=0.02)
    np.testing.assert_allclose(totals, totals[-1], atol=0.02)
    # Forty steps of 1° tell it to 0.16°.
    assert abs(np.degrees(rate) - planted_deg) < 0.5
