"""What describes a graph of photos without saying anything of it: axes, names, order, directions, copies, signs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import Solution, ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe, SyntheticGraph
from rotavg_ros.errors import UserError
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver import METHODS
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.sfm.options import PAPER_PARTS
from rotavg_ros.view_graph import EdgeLabel
from test.solver.graphs import random_truth

NETWORK_METHODS = ("neurora", "neurora-v1", "neurora-v2", "cleannet-spt", "spt-finenet", "spt", "neurora-round")
# The paper's networks know the cameras' axes that they were trained in; all the rest must not matter to them, either.
AS_WRITTEN = ("neurora-paper", "neurora-v2-paper", "cleannet-spt-paper", "spt-finenet-paper", "spt-paper")
BASELINES = ("chatterjee", "geman-mcclure", "weiszfeld", "arrigoni", "wang")
# The published iteration stops before it has converged, and its steps know the axes.
_TOLERANCES = {"wang": 0.03}
# Flags may differ where a score is as near as this to the threshold.
_THRESHOLD, _MARGIN = 0.5, 0.01
_TURN = torch.tensor([[0.5, -0.5, 0.5, 0.5]], dtype=torch.float64)
FRAMES = {
    "ROS body axes": _TURN,
    "a quarter about z": rotations.exp(torch.tensor([[0.0, 0.0, np.pi / 2]], dtype=torch.float64)),
    "anyhow": rotations.random(1, generator=torch.Generator().manual_seed(1)),
    "otherwise": rotations.random(1, generator=torch.Generator().manual_seed(2)),
}


class Described(NamedTuple):
    """Another description of a graph.

    Attributes:
        graph: as it is described.
        node, edge: where the first graph's nodes and edges are in it.
    """

    graph: ViewGraph
    node: Tensor
    edge: Tensor


def _as_it_is(graph: ViewGraph) -> Described:
    return Described(graph, torch.arange(graph.num_nodes), torch.arange(graph.num_edges))


def _relabelled(graph: ViewGraph, rng: np.random.Generator) -> Described:
    name = torch.from_numpy(rng.permutation(graph.num_nodes))
    return _as_it_is(graph)._replace(
        graph=replace(graph, source=name[graph.source], target=name[graph.target]), node=name
    )


def _shuffled(graph: ViewGraph, rng: np.random.Generator) -> Described:
    order = torch.from_numpy(rng.permutation(graph.num_edges))
    return _as_it_is(graph)._replace(graph=graph.select_edges(order), edge=order.argsort())


def _turned_round(graph: ViewGraph, is_reversed: Tensor) -> ViewGraph:
    return replace(
        graph,
        source=torch.where(is_reversed, graph.target, graph.source),
        target=torch.where(is_reversed, graph.source, graph.target),
        target_from_source=torch.where(
            is_reversed[:, None], rotations.inverse(graph.target_from_source), graph.target_from_source
        ),
    )


def _reversed(graph: ViewGraph, rng: np.random.Generator) -> Described:
    is_reversed = torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    return _as_it_is(graph)._replace(graph=_turned_round(graph, is_reversed))


def _copied(graph: ViewGraph, rng: np.random.Generator) -> Described:
    """A tenth of the edges stands there twice, some of them the other way round."""
    again = torch.from_numpy(rng.choice(graph.num_edges, graph.num_edges // 10, replace=False))
    twice = graph.select_edges(torch.cat((torch.arange(graph.num_edges), again)))
    is_reversed = torch.from_numpy(rng.random(twice.num_edges) < 0.5)
    return _as_it_is(graph)._replace(graph=_turned_round(twice, is_reversed))


DESCRIPTIONS: dict[str, Callable[[ViewGraph, np.random.Generator], Described]] = {
    "nodes relabelled": _relabelled,
    "edges shuffled": _shuffled,
    "half of the edges reversed": _reversed,
    "a tenth of the edges twice": _copied,
}
SAMPLES: dict[str, SyntheticGraph] = {
    "released": ReleasedRecipe(cameras=(70, 70)).sample(np.random.default_rng(3)),
    "axes anywhere": ReleasedRecipe(cameras=(70, 70), planar=False).sample(np.random.default_rng(4)),
    "paper": PaperRecipe(cameras=(60, 60), pair_share=(0.4, 0.4)).sample(np.random.default_rng(5)),
    "complete": PaperRecipe(cameras=(30, 30), pair_share=(1.0, 1.0)).sample(np.random.default_rng(6)),
}


def _with_axes(graph: ViewGraph, axes: Tensor) -> ViewGraph:
    """Cameras with other axes: rel → A rel A⁻¹."""
    turned = rotations.multiply(rotations.multiply(axes, graph.target_from_source), rotations.inverse(axes))
    return replace(graph, target_from_source=rotations.canonical(turned))


def _solved(graph: ViewGraph, method: str) -> Solution:
    return solve(graph, profile="sfm", method=method)


def _assert_same_flags(score: Tensor, expected: Tensor) -> None:
    is_clear = (expected - _THRESHOLD).abs() > _MARGIN
    assert torch.equal((score > _THRESHOLD)[is_clear], (expected > _THRESHOLD)[is_clear])


def _furthest_deg(found: Tensor, expected: Tensor) -> float:
    """Largest angle between orientations after one rotation of the world."""
    return float(torch.rad2deg(orientation_errors(found, expected)).max())


# Of the baselines these two take tens of seconds.
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(name, marks=pytest.mark.large if name in ("wang", "weiszfeld") else ())
        for name in (*NETWORK_METHODS, "neurora-paper~axes", *BASELINES)
    ],
)
@pytest.mark.parametrize("kind", ["released", pytest.param("paper", marks=pytest.mark.large)])
def test_the_cameras_axes_do_not_matter(kind: str, method: str) -> None:
    sample = SAMPLES[kind]
    expected = _solved(sample.graph, method)
    error = orientation_errors(expected.body_from_world, sample.body_from_world)
    for axes in FRAMES.values():
        found = _solved(_with_axes(sample.graph, axes), method)
        truth = rotations.multiply(axes, sample.body_from_world)
        turned = orientation_errors(found.body_from_world, truth)
        for figure in (torch.mean, torch.median):
            assert float(figure(turned)) == pytest.approx(float(figure(error)), rel=_TOLERANCES.get(method, 0.01))
        _assert_same_flags(found.outlier_score, expected.outlier_score)


@pytest.mark.parametrize("axes", FRAMES.values(), ids=FRAMES)
@pytest.mark.parametrize("kind", SAMPLES)
def test_networks_see_the_same_graph_in_any_axes(kind: str, axes: Tensor) -> None:
    """By construction, not by training: to rounding."""
    graph = SAMPLES[kind].graph
    form, other = CanonicalForm.of(graph), CanonicalForm.of(_with_axes(graph, axes))
    assert torch.equal(form.node, other.node) and torch.equal(form.edge, other.edge)
    torch.testing.assert_close(other.graph.target_from_source, form.graph.target_from_source, atol=1e-11, rtol=0)


@pytest.mark.parametrize("method", [*NETWORK_METHODS, *AS_WRITTEN])
@pytest.mark.parametrize("description", DESCRIPTIONS)
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=() if kind in ("released", "paper") else pytest.mark.large) for kind in SAMPLES]
)
def test_names_order_directions_and_copies_do_not_matter(kind: str, description: str, method: str) -> None:
    graph = SAMPLES[kind].graph
    expected = _solved(graph, method)
    described = DESCRIPTIONS[description](graph, np.random.default_rng(7))
    found = _solved(described.graph, method)
    assert _furthest_deg(found.body_from_world[described.node], expected.body_from_world) < 1e-3
    _assert_same_flags(found.outlier_score[described.edge], expected.outlier_score)


@pytest.mark.parametrize("method", ["neurora", "neurora-v1"])
def test_the_gauge_of_a_start_does_not_matter(method: str) -> None:
    sample = SAMPLES["released"]
    start, gauge = sample.body_from_world, rotations.random(1, generator=torch.Generator().manual_seed(3))
    answers = [
        solve(sample.graph, profile="sfm", method=method, warm_start=begun).body_from_world
        for begun in (start, rotations.multiply(start, gauge))
    ]
    assert _furthest_deg(answers[1], answers[0]) < 1e-3


@pytest.mark.parametrize("seed", [0, 1])
def test_the_order_of_edges_between_the_same_cameras_does_not_matter(seed: int) -> None:
    """Not even of those that turn by the same angle."""
    rng = np.random.default_rng(seed)
    pairs = np.repeat(np.stack(np.triu_indices(12, k=1))[:, rng.random(66) < 0.5], 3, axis=1)
    truth, axis = random_truth(12, seed), rng.standard_normal((pairs.shape[1], 3))
    quarter = Rotation.from_rotvec(np.pi / 2 * axis / np.linalg.norm(axis, axis=1)[:, None]).as_quat()
    noise = Rotation.from_rotvec(0.03 * rng.standard_normal((len(axis), 3)))
    stated = noise * truth[pairs[1]] * truth[pairs[0]].inv()
    stated = np.where(rng.random(len(axis))[:, None] < 0.5, quarter, stated.as_quat())
    graph = ViewGraph.create(*pairs, stated)
    described = _shuffled(graph, rng)
    expected, found = (_solved(one, "neurora") for one in (graph, described.graph))
    assert _furthest_deg(found.body_from_world, expected.body_from_world) < 1e-4
    torch.testing.assert_close(found.outlier_score[described.edge], expected.outlier_score, atol=1e-5, rtol=0)


def test_copies_count_once_and_all_have_a_verdict() -> None:
    graph = SAMPLES["paper"].graph
    described = _copied(graph, np.random.default_rng(8))
    expected, found = _solved(graph, "neurora"), _solved(described.graph, "neurora")
    assert found.outlier_score.shape == (described.graph.num_edges,)
    torch.testing.assert_close(found.outlier_score[: graph.num_edges], expected.outlier_score, atol=1e-6, rtol=0)
    form = CanonicalForm.of(described.graph)
    assert form.graph.num_edges == graph.num_edges
    of_form = torch.full((graph.num_edges,), torch.nan, dtype=torch.float64)
    of_form[form.edge[: graph.num_edges]] = found.outlier_score[: graph.num_edges]
    assert torch.equal(of_form[form.edge], found.outlier_score)


def test_only_copies_with_the_same_label_are_one() -> None:
    half_turn = [1.0, 0.0, 0.0, 0.0]
    relative = [half_turn, [-1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], half_turn, [0.0, 0.0, 0.6, 0.8]]
    label = [EdgeLabel.AUTOMATIC] * 3 + [EdgeLabel.REJECTED, EdgeLabel.AUTOMATIC]
    graph = ViewGraph.create([0, 1, 0, 0, 0], [1, 0, 1, 1, 1], relative, label=label)
    form = CanonicalForm.of(graph)
    assert form.graph.num_edges == 4  # the first two are one half turn
    assert form.edge[0] == form.edge[1]
    assert len(set(form.edge.tolist())) == 4


def _with_half_turns(graph: ViewGraph, share: float) -> ViewGraph:
    """A share of the edges states half turns about any axes."""
    rng = np.random.default_rng(9)
    chosen = torch.from_numpy(rng.random(graph.num_edges) < share)
    axis = torch.from_numpy(rng.standard_normal((graph.num_edges, 3)))
    half_turn = torch.cat((axis / axis.norm(dim=1, keepdim=True), torch.zeros(graph.num_edges, 1)), dim=1)
    return replace(graph, target_from_source=torch.where(chosen[:, None], half_turn, graph.target_from_source))


def _with_other_signs(graph: ViewGraph, seed: int) -> ViewGraph:
    """Some of the half turns by their other quaternions."""
    is_other = torch.from_numpy(np.random.default_rng(seed).random(graph.num_edges) < 0.5)
    is_other &= graph.target_from_source[:, 3] == 0
    measured = torch.where(is_other[:, None], -graph.target_from_source, graph.target_from_source)
    return replace(graph, target_from_source=measured)


@settings(max_examples=20)
@given(share=st.sampled_from([0.02, 0.3, 1.0]), seed=st.integers(0, 2**16), own_axes=st.booleans())
def test_half_turns_have_one_form(share: float, seed: int, own_axes: bool) -> None:
    graph = _with_half_turns(SAMPLES["complete"].graph, share)
    expected, found = (CanonicalForm.of(one, own_axes=own_axes) for one in (graph, _with_other_signs(graph, seed)))
    assert torch.equal(found.node, expected.node) and torch.equal(found.edge, expected.edge)
    assert torch.equal(found.graph.target_from_source, expected.graph.target_from_source)


@pytest.mark.parametrize("method", ["neurora", "neurora-v1", "neurora-paper"])
def test_which_of_its_quaternions_a_half_turn_has_does_not_matter(method: str) -> None:
    graph = _with_half_turns(SAMPLES["paper"].graph, 0.3)
    expected, found = (_solved(one, method) for one in (graph, _with_other_signs(graph, 1)))
    assert _furthest_deg(found.body_from_world, expected.body_from_world) < 1e-6
    torch.testing.assert_close(found.outlier_score, expected.outlier_score)


def test_a_form_and_back_is_the_graph() -> None:
    graph = SAMPLES["axes anywhere"].graph
    form = CanonicalForm.of(graph)
    truth = SAMPLES["axes anywhere"].body_from_world
    canonical = form.canonical_orientations(truth)
    torch.testing.assert_close(rotations.canonical(form.orientations(canonical)), rotations.canonical(truth))
    relative = rotations.multiply(canonical[form.graph.target], rotations.inverse(canonical[form.graph.source]))
    noise = rotations.angle_between(form.graph.target_from_source, relative)[form.edge]
    torch.testing.assert_close(noise, SAMPLES["axes anywhere"].noise_angle, atol=1e-7, rtol=0)


def test_each_component_has_axes_of_its_own() -> None:
    """As if it were alone."""
    graphs = [SAMPLES["paper"].graph, _with_axes(SAMPLES["released"].graph, FRAMES["anyhow"])]
    ends = [
        torch.cat([getattr(g, end) + at for g, at in zip(graphs, (0, 60), strict=True)]) for end in ("source", "target")
    ]
    both = ViewGraph.create(*ends, torch.cat([g.target_from_source for g in graphs]))
    joint, alone = CanonicalForm.of(both), [CanonicalForm.of(g) for g in graphs]
    edges = [joint.edge[: graphs[0].num_edges], joint.edge[graphs[0].num_edges :]]
    for form, edge in zip(alone, edges, strict=True):
        torch.testing.assert_close(
            joint.graph.target_from_source[edge], form.graph.target_from_source[form.edge], atol=1e-10, rtol=0
        )


def test_all_methods_that_photos_have_are_tried() -> None:
    """Whoever adds one with networks of its own adds it above, or here, if it is an ablation."""
    ablations = {
        f"neurora-{name}"
        for name in (
            *("unweighted", "half-norm", "equal-precisions", "scalar-precisions", "without-consensus"),
            *("without-finenet", "without-cleannet", "without-both", "without-cycles"),
        )
    }
    assert set(METHODS) == {*NETWORK_METHODS, *AS_WRITTEN, *BASELINES, *ablations}


def test_the_papers_parts_are_switched_one_by_one() -> None:
    """With all of them as this package has them it is this package's; each alone changes something."""
    graph = SAMPLES["released"].graph
    ours, papers = (_solved(graph, name).body_from_world for name in ("neurora-v1", "neurora-paper"))
    all_parts = ",".join(sorted(PAPER_PARTS))
    torch.testing.assert_close(_solved(graph, f"neurora-paper~{all_parts}").body_from_world, ours)
    for part in PAPER_PARTS:
        assert _furthest_deg(_solved(graph, f"neurora-paper~{part}").body_from_world, papers) > 0.01
    with pytest.raises(UserError, match="neurora-paper~ knows no part 'losses'"):
        _solved(graph, "neurora-paper~losses")
