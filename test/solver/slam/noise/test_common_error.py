"""Errors that neighbouring closures share: found where they are, not where they are not."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.noise.common_error import RunErrors, closure_runs, common_share, variance_factor
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.preparation import prepare
from rotavg_ros.solver.slam.stages import bootstrap, clean, refine_and_search


def test_runs_link_near_good_closures() -> None:
    pairs = AgreementPairs(
        np.array([0, 1, 2, 3]), np.array([1, 2, 3, 0]), np.array([5.0, 10.0, 500.0, 500.0]), np.zeros(4)
    )
    run = closure_runs(pairs, np.array([True, True, True, True]), np.arange(4.0))
    assert run[0] == run[1] == run[2] != run[3]
    run = closure_runs(pairs, np.array([True, False, True, True]), np.arange(4.0))
    assert len(set(run.tolist())) == 4


@pytest.mark.parametrize("spread", [0.0, 0.8])
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_the_share_of_a_common_error_is_estimated(share: float, spread: float) -> None:
    """Analysis of variance on known components, with nothing taken up by a fit."""
    rng = np.random.default_rng(0)
    run = np.repeat(np.arange(60), 8)
    own = np.sqrt(1 - share) * rng.standard_normal((480, 3))
    deviation = np.exp(spread * rng.standard_normal(480))
    residual = np.sqrt(share) * rng.standard_normal((60, 3))[run] + deviation[:, None] * own
    estimate = common_share(RunErrors(run, np.ones(480), residual, deviation**2, np.zeros((480, 4))), 1.0, 3)
    assert estimate == pytest.approx(share, abs=0.06)


def test_a_run_weighs_what_its_mean_is_worth() -> None:
    factor = variance_factor(np.array([0, 0, 0, 0, 1]), np.ones(5), 0.5)
    # Variance of the mean of four with half of it in common: 0.5 + 0.5 / 4, shared out over four.
    assert factor[:4].tolist() == pytest.approx([4 * (0.5 + 0.5 / 4)] * 4)
    assert factor[4] == 1


@pytest.mark.parametrize(("planted", "low", "high"), [(0.0, 0.0, 0.05), (0.8, 0.07, 0.9)])
def test_a_front_end_that_repeats_its_errors_is_recognised(planted: float, low: float, high: float) -> None:
    shares = []
    for seed in range(3):
        config = SlamSimulationConfig(
            world=World.LAPS,
            num_keyframes=1500,
            odometry_noise_deg=0.1,
            closures_per_keyframe=0.6,
            closure_noise_deg=2.0,
            closure_common_share=planted,
            false_share=0.2,
        )
        run = simulate_slam_graph(config, np.random.default_rng(seed))
        prepared = prepare(run.graph)
        cleaned = clean(None, prepared, run.graph.label)
        estimate = refine_and_search(
            prepared, cleaned, bootstrap(prepared, cleaned), stages=SlamStages(slip_search=False)
        )
        shares.append(estimate.common_share)
    assert low <= np.median(shares) <= high
