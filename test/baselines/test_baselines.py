"""What every baseline must do: exact where there is no noise, robust where there are outliers, blind to the gauge."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines import BASELINES, Baseline, blocks
from rotavg_ros.errors import UserError
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

METHODS = [pytest.param(method, id=name) for name, method in BASELINES.items()]
every_method = pytest.mark.parametrize("method", METHODS)


def orientations(num_nodes: int, seed: int = 0) -> Tensor:
    return rotations.random(num_nodes, generator=torch.Generator().manual_seed(seed))


def exact_graph(truth: Tensor, source: object, target: object) -> ViewGraph:
    """The noise-free graph of these edges."""
    source, target = torch.as_tensor(source, dtype=torch.int64), torch.as_tensor(target, dtype=torch.int64)
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    return ViewGraph.create(source, target, relative, num_nodes=len(truth))


def dense_graph(
    num_nodes: int, seed: int, noise: float = 0.0, outlier_share: float = 0.0, pair_share: float = 0.5
) -> tuple[ViewGraph, Tensor]:
    """A share of all pairs, with noise in radians and random rotations in place of some."""
    generator = torch.Generator().manual_seed(seed)
    truth = orientations(num_nodes, seed)
    source, target = torch.triu_indices(num_nodes, num_nodes, offset=1)
    kept = (torch.rand(len(source), generator=generator) < pair_share) | (target == source + 1)
    exact = exact_graph(truth, source[kept], target[kept])
    vectors = noise * torch.randn(exact.num_edges, 3, generator=generator, dtype=torch.float64)
    measured = rotations.multiply(exact.target_from_source, rotations.exp(vectors))
    replaced = torch.rand(exact.num_edges, generator=generator) < outlier_share
    measured[replaced] = rotations.random(int(replaced.sum()), generator=generator)
    return ViewGraph.create(exact.source, exact.target, measured, num_nodes=num_nodes), truth


def worst_error(estimate: Tensor, truth: Tensor, graph: ViewGraph) -> float:
    return float(orientation_errors(estimate, truth, graph.components()).max())


@every_method
@pytest.mark.parametrize(
    ("source", "target", "num_nodes"),
    [
        pytest.param([0], [1], 2, id="one edge"),
        pytest.param([1], [0], 2, id="one edge, new to old"),
        pytest.param(range(29), range(1, 30), 30, id="chain"),
        pytest.param(range(30), [*range(1, 30), 0], 30, id="ring"),
        pytest.param([0] * 9, range(1, 10), 10, id="star"),
        pytest.param([0, 0, 5, 7, 5], [1, 1, 6, 5, 6], 9, id="components, parallel edges and lone nodes"),
        pytest.param([], [], 3, id="no edge"),
    ],
)
def test_exact_without_noise(method: Baseline, source: object, target: object, num_nodes: int) -> None:
    truth = orientations(num_nodes)
    graph = exact_graph(truth, list(source), list(target))  # type: ignore[call-overload]
    estimate = method(graph, None)
    assert estimate.shape == (num_nodes, 4)
    assert estimate.dtype == torch.float64
    assert worst_error(estimate, truth, graph) < 1e-9


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [("chatterjee", 1e-6), ("geman-mcclure", 1e-6), ("weiszfeld", 1e-3), ("arrigoni", 1e-3), ("wang", 1e-2)],
)
def test_a_wrong_start_is_forgotten(name: str, tolerance: float) -> None:
    graph, truth = dense_graph(20, seed=1)
    vectors = 0.3 * torch.randn(20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    start = rotations.multiply(truth, rotations.exp(vectors))
    assert worst_error(start, truth, graph) > 0.5
    assert worst_error(BASELINES[name](graph, start), truth, graph) < tolerance


@every_method
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in (1, 2))])
def test_thirty_percent_outliers(method: Baseline, seed: int) -> None:
    """On all pairs, so that outliers are nowhere the majority, where ℓ1 would follow them."""
    graph, truth = dense_graph(40, seed, noise=np.radians(1), outlier_share=0.3, pair_share=1.0)
    assert np.degrees(worst_error(method(graph, None), truth, graph)) < 2


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(method, id=name, marks=pytest.mark.large if name == "wang" else ())
        for name, method in BASELINES.items()
    ],
)
def test_warm_start_from_every_other_method(method: Baseline) -> None:
    graph, truth = dense_graph(30, seed=4, noise=np.radians(1), outlier_share=0.2)
    for other in BASELINES.values():
        assert np.degrees(worst_error(method(graph, other(graph, None)), truth, graph)) < 5


@every_method
@settings(max_examples=3)
@given(seed=st.integers(0, 2**16))
def test_the_gauge_of_the_start_does_not_matter(method: Baseline, seed: int) -> None:
    graph, truth = dense_graph(12, seed=5, noise=0.02, outlier_share=0.1)
    gauge = orientations(1, seed)
    answer, turned = method(graph, truth), method(graph, rotations.multiply(truth, gauge))
    assert worst_error(turned, answer, graph) < 1e-6


@every_method
@settings(max_examples=3)
@given(seed=st.integers(0, 2**16))
def test_numbering_does_not_matter(method: Baseline, seed: int) -> None:
    """Nodes permuted, edges shuffled, some of them turned round; from a given start, since trees break ties."""
    graph, truth = dense_graph(12, seed=6, noise=0.02, outlier_share=0.1)
    generator = torch.Generator().manual_seed(seed)
    node = torch.randperm(12, generator=generator)
    order = torch.randperm(graph.num_edges, generator=generator)
    turned = torch.rand(graph.num_edges, generator=generator) < 0.5
    source, target = node[graph.source[order]], node[graph.target[order]]
    relative = graph.target_from_source[order]
    permuted = ViewGraph.create(
        torch.where(turned, target, source),
        torch.where(turned, source, target),
        torch.where(turned[:, None], rotations.inverse(relative), relative),
    )
    start = torch.empty_like(truth)
    start[node] = truth
    assert worst_error(method(permuted, start)[node], method(graph, truth), graph) < 1e-2


@every_method
@settings(max_examples=3)
@given(seed=st.integers(0, 2**16), num_edges=st.integers(1, 30))
def test_nonsense_gives_rotations(method: Baseline, seed: int, num_edges: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    source = torch.randint(0, 10, (num_edges,), generator=generator)
    target = (source + torch.randint(1, 10, (num_edges,), generator=generator)) % 10
    relative = rotations.random(num_edges, generator=generator)
    half_turns = torch.rand(num_edges, generator=generator) < 0.3
    relative[half_turns] = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    kind = torch.randint(0, 2, (num_edges,), generator=generator)
    estimate = method(ViewGraph.create(source, target, relative, num_nodes=10, kind=kind), None)
    torch.testing.assert_close(estimate.norm(dim=1), torch.ones(10, dtype=torch.float64))


@every_method
def test_rejected_edges_take_no_part(method: Baseline) -> None:
    truth = orientations(10)
    graph = exact_graph(truth, [*range(9), 0, 2], [*range(1, 10), 9, 7])
    wrong = graph.target_from_source.clone()
    wrong[9:] = orientations(2, seed=9)
    label = torch.tensor([EdgeLabel.AUTOMATIC] * 9 + [EdgeLabel.REJECTED] * 2)
    kind = torch.tensor([EdgeKind.ODOMETRY] * 9 + [EdgeKind.LOOP_CLOSURE] * 2)
    for kinds in (None, kind):
        graph = ViewGraph.create(graph.source, graph.target, wrong, label=label, kind=kinds)
        assert worst_error(method(graph, None), truth, graph) < 1e-9


@pytest.mark.parametrize("name", ["arrigoni", "wang"])
def test_too_large_for_memory(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(blocks, "MAX_BLOCKS", 20)
    graph, _ = dense_graph(12, seed=0)
    with pytest.raises(UserError, match="too many for arrigoni and wang"):
        BASELINES[name](graph, None)


def test_least_unsquared_deviations_recovers_inliers_exactly() -> None:
    """The theorem of Wang & Singer: without noise on the inliers, outliers do no harm at all."""
    graph, truth = dense_graph(40, seed=7, outlier_share=0.3, pair_share=1.0)
    assert np.degrees(worst_error(BASELINES["wang"](graph, None), truth, graph)) < 0.1


def test_thirty_eigenvectors_give_the_full_programme_s_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("rotavg_ros.baselines.wang")
    graph, truth = dense_graph(22, seed=1, noise=0.1, outlier_share=0.3)
    monkeypatch.setattr(module, "_MAX_TURNS", 1000)
    monkeypatch.setattr(module, "_CONVERGED_CHANGE", 1e-5)
    truncated = BASELINES["wang"](graph, None)
    monkeypatch.setattr(module, "_MAX_RANK", 66)
    assert np.degrees(worst_error(truncated, BASELINES["wang"](graph, None), graph)) < 0.1
    assert np.degrees(worst_error(truncated, truth, graph)) > 1


def test_odometry_is_the_start_of_a_pose_graph() -> None:
    """A false closure over a long chain does not bend it."""
    truth = orientations(60)
    graph = exact_graph(truth, [*range(59), 0, 10], [*range(1, 60), 59, 45])
    measured = graph.target_from_source.clone()
    measured[-1] = orientations(1, seed=3)[0]
    kind = [EdgeKind.ODOMETRY] * 59 + [EdgeKind.LOOP_CLOSURE] * 2
    precision = [4e4] * 59 + [400.0] * 2
    graph = ViewGraph.create(graph.source, graph.target, measured, kind=kind, precision=precision)
    assert np.degrees(worst_error(BASELINES["chatterjee"](graph, None), truth, graph)) < 2


@pytest.mark.parametrize("seed", range(3))
def test_geman_mcclure_is_at_a_minimum_of_its_cost(seed: int) -> None:
    """As SciPy's minimiser sees it, which knows the cost alone, written down once more in SciPy's rotations."""
    graph, truth = dense_graph(8, seed=20 + seed, noise=np.radians(2), outlier_share=0.2, pair_share=1.0)
    source, target = graph.source.numpy(), graph.target.numpy()
    measured = Rotation.from_quat(graph.target_from_source.numpy())
    scale = np.radians(5)

    def cost(turns: np.ndarray, begun: Rotation) -> float:
        body_from_world = begun * Rotation.from_rotvec(np.concatenate((np.zeros(3), turns)).reshape(-1, 3))
        residual = body_from_world[target].inv() * measured * body_from_world[source]
        square = residual.magnitude() ** 2
        return float((scale**2 * square / (2 * (scale**2 + square))).sum())

    answer = Rotation.from_quat(BASELINES["geman-mcclure"](graph, None).numpy())
    nothing = np.zeros(21)
    at_answer = cost(nothing, answer)
    lowest = minimize(cost, nothing, args=(answer,), method="BFGS", options={"gtol": 1e-9})
    assert at_answer - lowest.fun < 1e-9
    from_truth = minimize(cost, nothing, args=(Rotation.from_quat(truth.numpy()),), method="BFGS")
    assert from_truth.fun == pytest.approx(at_answer, rel=1e-5)
    assert at_answer < 0.999 * cost(nothing, Rotation.from_quat(BASELINES["chatterjee"](graph, None).numpy()))
