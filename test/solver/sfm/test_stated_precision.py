"""Precisions that edges state: believed where residuals bear them out, and not where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.sfm.stated.precision import Residuals, relative_variance


def _uneven(seed: int, num_nodes: int = 60) -> tuple[ViewGraph, torch.Tensor, np.ndarray]:
    """Edges of very different noise, a tenth of them outliers, the truth, and each edge's true precision."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(num_nodes, random_state=seed)
    source, target = np.triu_indices(num_nodes, k=1)
    kept = rng.random(len(source)) < 0.3
    source, target = source[kept], target[kept]
    sigma = np.radians(2) * np.exp(rng.normal(0, 1.0, len(source)))
    noise = Rotation.from_rotvec(sigma[:, None] * rng.standard_normal((len(source), 3)))
    relative = (truth[target] * truth[source].inv() * noise).as_quat()
    wrong = rng.random(len(source)) < 0.1
    relative[wrong] = Rotation.random(int(wrong.sum()), random_state=seed + 1).as_quat()
    graph = ViewGraph.create(source, target, relative, num_nodes=num_nodes)
    return graph, torch.from_numpy(truth.as_quat()), sigma**-2.0


def _alone(angle: torch.Tensor, redundancy: int) -> Residuals:
    """Of one component."""
    return Residuals(angle, torch.zeros(len(angle), dtype=torch.int64), torch.tensor([redundancy]))


def _error(graph: ViewGraph, truth: torch.Tensor) -> float:
    return float(orientation_errors(solve(graph, profile="sfm").body_from_world, truth).mean())


@pytest.mark.large
@settings(max_examples=8)
@given(st.integers(0, 2**16))
def test_precisions_that_are_noise_change_little(seed: int) -> None:
    graph, truth, precision = _uneven(seed)
    shuffled = np.random.default_rng(seed + 2).permutation(precision)
    plain, misled = (
        _error(replace(graph, precision=torch.from_numpy(p)), truth) for p in (precision * np.nan, shuffled)
    )
    assert misled == pytest.approx(plain, rel=0.03)


def test_true_precisions_help_and_their_unit_does_not_matter() -> None:
    plain, told, in_other_units = [], [], []
    for seed in range(4):
        graph, truth, precision = _uneven(seed)
        plain.append(_error(graph, truth))
        for errors, unit in ((told, 1.0), (in_other_units, 1e-3)):
            errors.append(_error(replace(graph, precision=torch.from_numpy(unit * precision)), truth))
    assert np.mean(told) < 0.92 * np.mean(plain)
    np.testing.assert_allclose(in_other_units, told, rtol=1e-6)


@settings(max_examples=20)
@given(st.integers(0, 2**16), st.sampled_from([0.0, 0.5, 1.0]))
def test_the_exponent_is_found(seed: int, exponent: float) -> None:
    """Normal residuals, whose density is not the one assumed, with a fifth of them anything."""
    rng = np.random.default_rng(seed)
    precision = np.exp(rng.normal(3, 1.5, 3000))
    vectors = 0.05 * precision[:, None] ** (-exponent / 2) * rng.standard_normal((3000, 3))
    angle = np.where(rng.random(3000) < 0.2, rng.uniform(0, np.pi, 3000), np.linalg.norm(vectors, axis=1))
    found = relative_variance(torch.from_numpy(precision), _alone(torch.from_numpy(angle), 2900))
    if exponent == 0:
        assert found is None
        return
    assert found is not None
    slope = np.polyfit(-np.log(precision), np.log(found.numpy()), 1)[0]
    assert slope == pytest.approx(exponent, abs=0.15)


def test_each_component_is_believed_by_itself() -> None:
    """Three at once, of which the second has no edges, as each alone."""
    rng = np.random.default_rng(0)
    precision = torch.from_numpy(np.exp(rng.normal(0, 1.0, 900)))
    angle = torch.from_numpy(np.abs(rng.normal(0, 0.1, 900)))
    angle[:500] /= precision[:500].sqrt()
    component = torch.tensor([0] * 500 + [2] * 400)
    together = relative_variance(precision, Residuals(angle, component, torch.tensor([450, 0, 350])))
    alone = relative_variance(precision[:500], _alone(angle[:500], 450))
    assert together is not None and alone is not None
    torch.testing.assert_close(together[:500], alone)
    torch.testing.assert_close(together[500:], torch.ones(400, dtype=torch.float64))


def test_nothing_is_believed_where_nothing_checks_or_differs() -> None:
    angle = torch.rand(50, dtype=torch.float64)
    spread = torch.logspace(0, 3, 50, dtype=torch.float64)
    assert relative_variance(spread, _alone(angle, 0)) is None
    assert relative_variance(torch.full((50,), 7.0, dtype=torch.float64), _alone(angle, 40)) is None
    assert relative_variance(torch.full((50,), torch.nan, dtype=torch.float64), _alone(angle, 40)) is None


def test_copies_state_the_highest_precision_of_any() -> None:
    relative = Rotation.random(3, random_state=0).as_quat()
    graph = ViewGraph.create([0, 1, 0, 2], [1, 2, 1, 0], relative[[0, 1, 0, 2]], precision=[2.0, np.nan, 5.0, 3.0])
    for order in ([0, 1, 2, 3], [2, 3, 1, 0]):
        form = CanonicalForm.of(graph.select_edges(torch.tensor(order)))
        place = form.edge[[order.index(number) for number in (0, 2, 1, 3)]]
        np.testing.assert_array_equal(form.graph.precision[place].numpy(), [5.0, 5.0, np.nan, 3.0])


@pytest.mark.parametrize("states_shapes", [False, True])
def test_where_only_an_edge_that_nothing_checks_states_something_it_tells_nothing(states_shapes: bool) -> None:
    """A triangle that states nothing, and a bridge to a fourth camera that does."""
    turns = Rotation.from_rotvec([[0.1, 0, 0], [0, 0.2, 0], [0.3, 0.1, 0], [0, 0, 0.5]]).as_quat()
    silent = ViewGraph.create([0, 1, 0, 2], [1, 2, 2, 3], turns)
    if states_shapes:
        stated = ViewGraph.create(
            silent.source,
            silent.target,
            turns,
            information=[*[np.full((3, 3), np.nan)] * 3, np.diag([1.0, 4.0, 9.0])],
        )
    else:
        stated = replace(silent, precision=torch.tensor([torch.nan] * 3 + [4.0], dtype=torch.float64))
    assert torch.equal(solve(stated).body_from_world, solve(silent).body_from_world)
