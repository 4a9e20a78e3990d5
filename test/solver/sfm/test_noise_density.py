"""Which density of noise the last steps go by."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.stats import gennorm

from rotavg_ros import ViewGraph, solve
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.sfm.noise_density import NoiseDensity
from rotavg_ros.solver.sfm.priors import DensityPriors
from test.solver.graphs import as_quaternions, measured, random_truth

PRIORS = DensityPriors()


def lengths(exponent: float, scale: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Of vectors in space of density exp(−(r/s)^β): (r/s)^β has a gamma distribution."""
    return scale * rng.gamma(3 / exponent, size=count) ** (1 / exponent)


def _moment(length: float, exponent: float, power: int) -> float:
    return float(length**power * gennorm.pdf(length, exponent))


def fitted(length: np.ndarray, component: np.ndarray | None = None, count: int = 1) -> NoiseDensity:
    of = torch.zeros(len(length), dtype=torch.int64) if component is None else torch.from_numpy(component)
    return NoiseDensity.fitted(torch.from_numpy(length**2), of, of, torch.zeros(count, dtype=torch.float64), PRIORS)


def test_the_draw_is_of_the_density() -> None:
    """scipy's generalised normal in one dimension is the same family: moments of vectors by its integral."""
    rng = np.random.default_rng(0)
    for exponent in PRIORS.exponents:
        drawn = np.mean(lengths(exponent, 1.0, 200_000, rng) ** 2)
        over, under = (quad(_moment, 0, np.inf, (exponent, power))[0] for power in (4, 2))
        assert drawn == pytest.approx(over / under, rel=0.05)


@settings(max_examples=15, deadline=None)
@given(st.sampled_from(PRIORS.exponents), st.floats(-7, -1), st.floats(0, 0.4), st.integers(0, 2**16))
def test_it_is_found(exponent: float, log_scale: float, false_share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scale = math.exp(log_scale) / 10 ** (1 / exponent)
    length = lengths(exponent, scale, 4000, rng)
    false = rng.random(4000) < false_share
    length[false] = Rotation.random(int(false.sum()), rng).magnitude()
    found = fitted(length)
    assert float(found.exponent[0]) == exponent
    assert float(found.scale[0]) == pytest.approx(scale, rel=0.25)
    weight = found.weigh(torch.from_numpy(length**2), slice(0, 4000))
    assert bool((weight > 0).all() and torch.isfinite(weight).all())


def test_weights_are_those_of_the_density() -> None:
    """Minus the derivative of log p over r, for edges that are surely good."""
    rng = np.random.default_rng(3)
    found = fitted(lengths(1.5, 0.01, 5000, rng))
    at, step = torch.tensor([0.002, 0.01, 0.02], dtype=torch.float64), 1e-7
    slope = ((at + step) / found.scale) ** found.exponent - ((at - step) / found.scale) ** found.exponent
    expected = slope / (2 * step) / at
    torch.testing.assert_close(found.weigh(at**2, torch.tensor([0, 1, 2])), expected, rtol=1e-3, atol=0)


def test_each_component_has_its_own() -> None:
    rng = np.random.default_rng(1)
    length = np.concatenate((lengths(2.0, 0.02, 1000, rng), lengths(0.5, 1e-4, 1000, rng)))
    found = fitted(length, np.repeat([0, 1], 1000), 2)
    assert found.exponent.tolist() == [2.0, 0.5]
    assert found.is_other.tolist() == [True, False]


def test_few_edges_tell_nothing() -> None:
    found = fitted(lengths(2.0, 0.02, 8, np.random.default_rng(0)))
    assert not bool(found.is_other.any())


def errors_deg(graph: ViewGraph, truth: Rotation, method: str) -> float:
    errors = orientation_errors(solve(graph, method=method, profile="sfm").body_from_world, as_quaternions(truth))
    return float(torch.rad2deg(errors).mean())


@pytest.mark.parametrize("false_share", [0.0, 0.3])
def test_normal_noise_is_averaged_by_squares(false_share: float) -> None:
    ratios = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        source, target = np.triu_indices(80, k=1)
        kept = rng.random(len(source)) < 0.4
        source, target = source[kept], target[kept]
        noise = Rotation.from_rotvec(np.radians(4.0) * rng.normal(size=(len(source), 3))).as_quat()
        false = rng.random(len(source)) < false_share
        noise = np.where(false[:, None], Rotation.random(len(source), rng).as_quat(), noise)
        truth = random_truth(80, seed)
        graph = measured(truth, source, target, Rotation.from_quat(noise))
        ratios.append(errors_deg(graph, truth, "neurora") / errors_deg(graph, truth, "neurora-half-norm"))
    assert np.mean(ratios) < 0.9


def test_exact_edges_tell_of_no_density() -> None:
    """Their residuals say where steps ended; in a density of these, all edges are false after the next step."""
    rng = np.random.default_rng(13)
    source, target = np.triu_indices(40, k=1)
    kept = rng.random(len(source)) < 0.4
    source, target = source[kept], target[kept]
    false = rng.random(len(source)) < 0.4
    noise = np.where(false[:, None], Rotation.random(len(source), rng).as_quat(), [0, 0, 0, 1])
    truth = random_truth(40, 13)
    assert errors_deg(measured(truth, source, target, Rotation.from_quat(noise)), truth, "neurora") < 1e-3


@pytest.mark.large
@pytest.mark.parametrize("recipe", [ReleasedRecipe(cameras=(150, 200)), PaperRecipe(cameras=(150, 200))])
def test_where_half_is_right_nothing_changes(recipe: ReleasedRecipe | PaperRecipe) -> None:
    graph = recipe.sample(np.random.default_rng(7)).graph
    ours, half = (solve(graph, method=method) for method in ("neurora", "neurora-half-norm"))
    assert torch.equal(ours.body_from_world, half.body_from_world)
    assert torch.equal(ours.outlier_score, half.outlier_score)
