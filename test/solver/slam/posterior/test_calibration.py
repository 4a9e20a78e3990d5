"""What a bias and a mounting are worth to F: against the dense integral, and against F once they are taken out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.noise.mounting import without_mounting
from rotavg_ros.solver.slam.posterior.calibration import Calibrated
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.objective import Evaluation
from rotavg_ros.solver.slam.posterior.solve import Drawn
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.view_graph import EdgeLabel

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


def test_rejected_closures_do_not_tilt_a_bias_in_the_plane() -> None:
    graph, _ = planar(0, 8, 0.0)
    off_plane = rotations.exp(torch.tensor([1.5, -0.5, 1.0]).double())
    measured, label = graph.target_from_source.clone(), graph.label.clone()
    measured[-2:], label[-2:] = off_plane, EdgeLabel.REJECTED
    problem = problem_of(replace(graph, target_from_source=measured, label=label), rate=0.01)
    assert problem.components == 1 and problem.calibrated is not None
    np.testing.assert_allclose(np.abs(problem.calibrated.axes[0, :3]), [0, 0, 1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["hills: 30 % random", "sphere: 30 % random"])
@pytest.mark.parametrize("degrees", [0.0, 4.0])
def test_f_falls_by_what_a_step_on_the_mounting_promises(kind: str, degrees: float) -> None:
    """Labels and noise held, from a map that was fitted without; its normal equations are those that are left."""
    case = next(one for one in KINDS if one.name == kind).drawn(1)
    graph = without_mounting(case.graph, np.radians(degrees) * np.array([0.6, -0.64, 0.48]))

    def polished(calibration: Calibration | None) -> tuple[Drawn, State, Evaluation]:
        drawn = Drawn.of(graph, None, (), calibration, GAUSSIAN_PRIORS)
        problem = drawn.problem
        edge = problem.graph.view_graph_edge[problem.closure - problem.graph.num_segments]
        return drawn, *polish(problem, state_of(problem, case.is_false[edge]), hold_noise=True)

    drawn, state, before = polished(None)
    tried = Calibrated.of(graph, drawn.prepared, Calibration.none(), {"mounting"})
    ends = drawn.problem.graph.source, state, before.residual, before.factorised
    information, change = tried.information(*ends, GAUSSIAN_PRIORS)
    promised = tried.cost(information, GAUSSIAN_PRIORS) - float(change @ information @ change) / 2
    _, _, after = polished(Calibration.none().moved(change @ tried.axes))
    assert after.total - before.total == pytest.approx(promised, rel=0.05, abs=0.3)
    # Without it the step would cost what is not known of it, and with it gains more the farther it is off.
    assert promised > 0 if degrees == 0 else promised < -5
