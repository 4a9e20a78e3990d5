"""The SLAM noise model: densities that integrate to one, variances that are found again."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.solver.slam.graph.agreement import agreement_pairs
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.model import NoiseModel, discrepancies, estimate_noise
from rotavg_ros.solver.slam.preparation import prepare
from test.solver.graphs import measured, random_truth, slam_edges, small_noise


def test_uniform_densities_integrate_to_one() -> None:
    def shell(angle: float) -> float:
        return float(4 * np.pi * angle**2 * np.exp(log_uniform_density(np.array([angle]), 3))[0])

    assert quad(shell, 0, np.pi)[0] == pytest.approx(1)
    assert float(np.exp(log_uniform_density(np.zeros(1), 1))[0]) == pytest.approx(1 / (2 * np.pi))


def test_log_odds_are_a_ratio_of_densities() -> None:
    model = NoiseModel(3, 1e-4, 1e-3, 0.5)
    square, variance = np.array([0.0, 0.01, 1.0]), np.array([0.01, 0.02, 0.3])
    gaussian = np.exp(-square / (2 * variance)) / (2 * np.pi * variance) ** 1.5
    expected = np.log(gaussian) - log_uniform_density(np.sqrt(square), 3)
    np.testing.assert_allclose(model.inlier_log_odds(square, variance), expected)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize(
    ("step_deg", "closure_deg", "false_share"), [(0.2, 1.0, 0.3), (1.0, 0.5, 0.6), (0.3, 3.0, 0.0)]
)
def test_scales_are_found_again(planar: bool, step_deg: float, closure_deg: float, false_share: float) -> None:
    """All closures share one random walk, so its scale is seen about once per component; factors of two are fine."""
    source, target, kind = slam_edges(1500, 900, 7)
    sigma = np.where(kind == 0, step_deg, closure_deg)
    noise = small_noise(len(source), sigma, 8, planar).as_quat()
    false = np.random.default_rng(9).random(len(source)) < false_share
    false &= kind == 1
    yaw = np.random.default_rng(10).uniform(-np.pi, np.pi, (int(false.sum()), 1)) * [0, 0, 1]
    random = Rotation.from_rotvec(yaw) if planar else Rotation.random(int(false.sum()), random_state=10)
    noise[false] = random.as_quat()
    graph = measured(random_truth(1500, 3, planar), source, target, Rotation.from_quat(noise), kind=kind)
    model = prepare(graph).noise
    assert model.components == (1 if planar else 3)
    assert 0.6 < np.degrees(np.sqrt(model.step_variance)) / step_deg < 1.5
    assert 0.5 < np.degrees(np.sqrt(model.closure_variance)) / closure_deg < 2
    assert model.outlier_share == pytest.approx(false_share, abs=0.06)


def test_scales_are_found_again_where_robots_meet() -> None:
    """Eight chains that only closures connect: what lies between two chains is no number of steps."""
    source, target, kind = slam_edges(800, 300, 7)
    is_kept = (kind == 1) | (target % 100 != 0)
    source, target, kind = source[is_kept], target[is_kept], kind[is_kept]
    noise = small_noise(len(source), np.where(kind == 0, 0.5, 1.0), 8)
    prepared = prepare(measured(random_truth(800, 3), source, target, noise, kind=kind))
    assert 0.5 < np.degrees(np.sqrt(prepared.noise.step_variance)) / 0.5 < 2
    assert 0.5 < np.degrees(np.sqrt(prepared.noise.closure_variance)) / 1.0 < 2
    pairs, graph = prepared.pairs, prepared.closure_graph
    chain = graph.nodes // 100
    ends = np.sort(np.stack((chain[graph.source], chain[graph.target]), axis=1)[graph.is_closure], axis=1)
    np.testing.assert_array_equal(ends[pairs.first], ends[pairs.second])


@pytest.mark.parametrize(("closure_deg", "false_share"), [(1.0, 0.2), (8.0, 0.0)])
def test_near_misses_and_noise_are_told_apart(closure_deg: float, false_share: float) -> None:
    """False closures that are off by 10–30° only, and good ones that err by nearly as much."""
    config = SlamSimulationConfig(
        world=World.SPHERE,
        dimensions=3,
        num_keyframes=800,
        odometry_noise_deg=0.5 * np.sqrt(3),
        closures_per_keyframe=1.0,
        closure_noise_deg=np.sqrt(3) * closure_deg,
        false_share=false_share,
        near_miss_share=1.0,
        in_place_share=1.0,
    )
    model = prepare(simulate_slam_graph(config, np.random.default_rng(1)).graph).noise
    assert 0.5 < np.degrees(np.sqrt(model.step_variance)) / 0.5 < 2
    assert 0.7 < np.degrees(np.sqrt(model.closure_variance)) / closure_deg < 1.5


def test_without_closures_the_prior_stands() -> None:
    source, target, kind = slam_edges(20, 0, 0)
    prepared = prepare(measured(random_truth(20, 0), source, target, kind=kind))
    assert len(agreement_pairs(prepared.closure_graph).first) == 0
    empty = np.empty(0)
    model = estimate_noise(discrepancies(empty, empty, prepared.pairs), 3)
    assert 0 < model.step_variance < 1 and 0 < model.outlier_share < 1


def _drift_with_wrong_closures_deg(seed: int) -> float:
    """Estimated step of an odometry of 0.2°, after 15 good closures and a run of four that are off by 10–37°."""
    rng = np.random.default_rng(seed)
    good_end, wrong_end = 700 + 5 * np.arange(15), np.array([1180, 1190, 1200, 1210])
    start, end = np.concatenate((good_end - 110, wrong_end - 115)), np.concatenate((good_end, wrong_end))
    source, target = np.append(np.arange(1299), start), np.append(np.arange(1, 1300), end)
    sigma = np.repeat([0.2, 1.5], [1299, len(end)])
    yaw = np.radians(sigma) * rng.standard_normal(len(sigma))
    yaw[-4:] += np.radians([-20.0, 37.0, -10.0, -30.0])
    noise = Rotation.from_rotvec(yaw[:, None] * [0, 0, 1])
    kind = np.repeat([0, 1], [1299, len(end)])
    noise_model = prepare(measured(random_truth(1300, seed, planar=True), source, target, noise, kind=kind)).noise
    return float(np.degrees(np.sqrt(noise_model.step_variance)))


def test_a_few_wrong_closures_in_a_row_do_not_pass_as_drift() -> None:
    """An odometry of 0.5° would explain them, too; the likeliest estimate is above 0.4° in half of the draws."""
    steps_deg = [_drift_with_wrong_closures_deg(seed) for seed in range(6)]
    assert np.median(steps_deg) < 0.25 and max(steps_deg) < 0.42
