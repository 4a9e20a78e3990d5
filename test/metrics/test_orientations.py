"""Errors of orientations: evo's own, where evo defines them, and what no common rotation changes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from evo.core.metrics import APE, RPE, PoseRelation, Unit
from evo.core.trajectory import PosePath3D
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.metrics import gauge_alignment, orientation_errors, true_edge_noise
from rotavg_ros.view_graph import ViewGraph

COUNT = 60


def noisy(seed: int = 0) -> tuple[Rotation, Rotation]:
    """60 orientations world_from_body, true and estimated: drifting, in a world that is turned by half a radian."""
    rng = np.random.default_rng(seed)
    true = Rotation.random(COUNT, rng=rng)
    drift = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.02, size=(COUNT, 3)), axis=0))
    return true, Rotation.from_rotvec([0.3, -0.4, 0.0]) * drift * true


def body_from_world(world_from_body: Rotation) -> torch.Tensor:
    return torch.from_numpy(world_from_body.inv().as_quat(canonical=True))


def path_of(world_from_body: Rotation) -> PosePath3D:
    return PosePath3D(np.zeros((COUNT, 3)), world_from_body.as_quat(scalar_first=True))


def test_absolute_errors_are_evos() -> None:
    true, estimate = noisy()
    ours = orientation_errors(body_from_world(estimate), body_from_world(true))
    # Our alignment is of orientations alone, which evo does not have; what it compares is aligned already.
    gauge = Rotation.from_quat(gauge_alignment(body_from_world(estimate), body_from_world(true)).numpy())
    metric = APE(PoseRelation.rotation_angle_rad)
    metric.process_data((path_of(true), path_of(gauge * estimate)))
    np.testing.assert_allclose(ours.numpy(), metric.error, atol=1e-9)


def test_an_answer_of_two_halves_turned_apart_is_laid_onto_the_larger_one() -> None:
    """49 % of it are turned by 100°: a median that is given up too early lies between the two."""
    rng = np.random.default_rng(0)
    true = Rotation.random(300, rng=rng)
    turn = np.where(np.arange(300)[:, None] < 147, [0.0, 0.0, np.radians(100.0)], 0.0)
    estimate = Rotation.from_rotvec(turn + rng.normal(scale=np.radians(0.5), size=(300, 3))) * true
    errors = orientation_errors(body_from_world(estimate), body_from_world(true))

    def mean_error(gauge: np.ndarray) -> float:
        return float((Rotation.from_rotvec(gauge) * estimate * true.inv()).magnitude().mean())

    best = minimize(mean_error, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12})
    assert float(errors.mean()) == pytest.approx(best.fun, abs=1e-6)
    assert float(errors.median()) < np.radians(5.0)


@pytest.mark.parametrize("delta", [1, 7])
def test_relative_errors_are_evos(delta: int) -> None:
    """The noise of an estimate's own steps is its relative pose error in rotation, whatever the gauge."""
    true, estimate = noisy(1)
    first = torch.arange(COUNT - delta)
    orientations = body_from_world(estimate)
    steps = rotations.multiply(orientations[first + delta], rotations.inverse(orientations[first]))
    ours = true_edge_noise(ViewGraph.create(first, first + delta, steps), body_from_world(true))
    metric = RPE(PoseRelation.rotation_angle_rad, delta=delta, delta_unit=Unit.frames, all_pairs=True)
    metric.process_data((path_of(true), path_of(estimate)))
    np.testing.assert_allclose(ours.numpy(), metric.error, atol=1e-9)


def test_components_have_gauges_of_their_own_and_gaps_stay_unknown() -> None:
    true, _ = noisy()
    component = torch.arange(COUNT) % 2
    gauges = Rotation.random(2, rng=np.random.default_rng(2))
    truth = body_from_world(true)
    truth[7] = torch.nan
    errors = orientation_errors(body_from_world(gauges[component.numpy()] * true), truth, component)
    assert torch.isnan(errors).nonzero().flatten().tolist() == [7]
    assert float(errors.nan_to_num().max()) < 1e-7


def test_the_alignment_is_robust() -> None:
    """A third of the orientations far off leave the others exact."""
    true, _ = noisy()
    is_off = np.arange(COUNT) % 3 == 0
    far_off = Rotation.random(COUNT, rng=np.random.default_rng(3)).as_quat()
    estimate = Rotation.from_quat(np.where(is_off[:, None], far_off, true.as_quat()))
    errors = orientation_errors(body_from_world(estimate), body_from_world(true)).numpy()
    assert errors[~is_off].max() < np.radians(0.1)


def test_edges_of_unknown_nodes_have_unknown_noise() -> None:
    truth = rotations.identity(3)
    truth[2] = torch.nan
    turned = rotations.exp(torch.tensor([[0.0, 0.0, 0.4], [0.0, 0.0, 0.4]], dtype=torch.float64))
    noise = true_edge_noise(ViewGraph.create([0, 1], [1, 2], turned), truth)
    assert float(noise[0]) == pytest.approx(0.4)
    assert bool(torch.isnan(noise[1]))
