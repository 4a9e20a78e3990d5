"""Information of single edges: believed where residuals bear it out, the same in every description, else harmless."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import Solution, ViewGraph, rotations, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.batch import solve_batch
from rotavg_ros.solver.sfm.laplacians.block import Arrivals, factorised
from rotavg_ros.solver.sfm.laplacians.edge import EdgeLaplacian, MatrixWeights
from rotavg_ros.solver.sfm.priors import NoiseShapePriors
from rotavg_ros.solver.sfm.stated.shape import FramedResiduals, believed_units
from rotavg_ros.solver.sfm.symmetric_rows import distinct_entries

SHAPE = NoiseShapePriors()
SCALAR = "neurora-scalar-precisions"


def _drawn(seed: int, num_nodes: int = 50, share: float = 0.3) -> tuple[ViewGraph, Tensor]:
    """Edges of which each has a covariance of its own and states it, a tenth of them outliers; and the truth."""
    rng = np.random.default_rng(seed)
    truth = Rotation.random(num_nodes, random_state=seed)
    source, target = np.triu_indices(num_nodes, k=1)
    kept = rng.random(len(source)) < share
    source, target = source[kept], target[kept]
    count = len(source)
    axes = Rotation.random(count, random_state=seed + 1)
    deviation = np.radians(2) * np.exp(rng.normal(0, 0.5, (count, 1)) + rng.normal(0, 0.9, (count, 3)))
    noise = Rotation.from_rotvec(axes.apply(deviation * rng.standard_normal((count, 3))))
    relative = (noise * truth[target] * truth[source].inv()).as_quat()
    wrong = rng.random(count) < 0.1
    relative[wrong] = Rotation.random(int(wrong.sum()), random_state=seed + 2).as_quat()
    matrix = axes.as_matrix()
    information = (matrix * deviation[:, None] ** -2.0) @ matrix.transpose(0, 2, 1)
    graph = ViewGraph.create(source, target, relative, num_nodes=num_nodes, information=information)
    return graph, torch.from_numpy(truth.as_quat())


def _stating(graph: ViewGraph, information: Tensor) -> ViewGraph:
    """The same edges with other information."""
    return ViewGraph.create(
        graph.source, graph.target, graph.target_from_source, num_nodes=graph.num_nodes, information=information
    )


def _solved(graph: ViewGraph, method: str = "neurora") -> Solution:
    return solve(graph, profile="sfm", method=method)


def _error(graph: ViewGraph, truth: Tensor, method: str = "neurora") -> float:
    return float(orientation_errors(_solved(graph, method).body_from_world, truth).mean())


def _assert_same_flags(score: Tensor, expected: Tensor) -> None:
    is_clear = (expected - 0.5).abs() > 0.01
    assert torch.equal((score > 0.5)[is_clear], (expected > 0.5)[is_clear])


@pytest.mark.large
def test_true_information_helps_more_than_its_size_alone() -> None:
    errors = {"full": [], "scalar": [], "none": []}  # type: dict[str, list[float]]
    for seed in range(1000, 1004):
        graph, truth = _drawn(seed)
        nothing = replace(graph, information=None, precision=torch.full_like(graph.precision, torch.nan))
        errors["full"].append(_error(graph, truth))
        errors["scalar"].append(_error(graph, truth, SCALAR))
        errors["none"].append(_error(nothing, truth))
    means = {name: np.mean(values) for name, values in errors.items()}
    assert means["full"] < 0.75 * means["scalar"]
    assert means["full"] < 0.7 * means["none"]


@pytest.mark.large
@settings(max_examples=2)
@given(st.integers(0, 2**16))
def test_information_that_is_noise_changes_little(seed: int) -> None:
    graph, truth = _drawn(seed)
    rng = np.random.default_rng(seed + 3)
    nothing = replace(graph, information=None, precision=torch.full_like(graph.precision, torch.nan))
    assert graph.information is not None
    factors = torch.from_numpy(rng.standard_normal((graph.num_edges, 3, 3)))
    shuffled = graph.information[torch.from_numpy(rng.permutation(graph.num_edges))]
    plain = _error(nothing, truth)
    for nonsense in (shuffled, factors @ factors.mT, torch.linalg.inv(graph.information)):
        assert _error(_stating(graph, nonsense), truth) == pytest.approx(plain, rel=0.03)


@pytest.mark.large
def test_nonsense_costs_less_than_a_hundredth_in_the_mean() -> None:
    plain, misled = [], []
    for seed in range(1010, 1018):
        graph, truth = _drawn(seed)
        assert graph.information is not None
        nothing = replace(graph, information=None, precision=torch.full_like(graph.precision, torch.nan))
        order = torch.from_numpy(np.random.default_rng(seed).permutation(graph.num_edges))
        plain.append(_error(nothing, truth))
        misled.append(_error(_stating(graph, graph.information[order]), truth))
    assert np.mean(misled) < 1.01 * np.mean(plain)


@settings(max_examples=2)
@given(st.integers(0, 2**16), st.floats(-8, 8))
def test_the_unit_of_information_does_not_matter(seed: int, exponent: float) -> None:
    graph, _ = _drawn(seed)
    assert graph.information is not None
    expected = _solved(graph)
    found = _solved(_stating(graph, 10**exponent * graph.information))
    torch.testing.assert_close(found.body_from_world, expected.body_from_world, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.outlier_score, expected.outlier_score, atol=1e-4, rtol=0)


def test_what_states_no_shape_changes_nothing_at_all() -> None:
    """Absent, unknown of every edge, or broken: bit for bit what the precisions alone give."""
    graph, _ = _drawn(5)
    expected = _solved(replace(graph, information=None))
    broken = torch.full((graph.num_edges, 3, 3), torch.nan, dtype=torch.float64)
    broken[::3], broken[1::3] = torch.diag(torch.tensor([1.0, 1.0, -1.0])).double(), torch.inf
    unknown = broken * torch.nan
    others = [_stating(graph, broken).information, unknown, torch.where(broken == torch.inf, torch.nan, broken)]
    for information in others:
        found = _solved(replace(graph, information=information))
        assert torch.equal(found.body_from_world, expected.body_from_world)
        assert torch.equal(found.outlier_score, expected.outlier_score)


def test_extreme_and_partly_unknown_information_is_survived() -> None:
    graph, truth = _drawn(6)
    assert graph.information is not None
    plain = _error(replace(graph, information=None, precision=graph.precision * torch.nan), truth)
    information = graph.information.clone()
    information[::4] = torch.nan
    information[1::40] = torch.diag(torch.tensor([1e-9, 1.0, 1e9])).double()  # conditioned beyond use: unknown
    information[2::40] = torch.diag(torch.tensor([1e-4, 1.0, 1e4])).double()
    assert _error(_stating(graph, information), truth) < plain


@settings(max_examples=3)
@given(st.integers(0, 2**16))
def test_names_order_and_directions_do_not_matter(seed: int) -> None:
    graph, _ = _drawn(seed)
    rng = np.random.default_rng(seed)
    expected = _solved(graph)
    order = torch.from_numpy(rng.permutation(graph.num_edges))
    name = torch.from_numpy(rng.permutation(graph.num_nodes))
    other = graph.reverse_edges(torch.from_numpy(rng.random(graph.num_edges) < 0.5)).select_edges(order)
    found = _solved(replace(other, source=name[other.source], target=name[other.target]))
    difference = orientation_errors(found.body_from_world[name], expected.body_from_world)
    assert float(torch.rad2deg(difference).max()) < 1e-3
    _assert_same_flags(found.outlier_score, expected.outlier_score[order])


def _with_axes(graph: ViewGraph, axes: Tensor) -> ViewGraph:
    """Cameras with other axes: rel → A rel A⁻¹, Ω → A Ω Aᵀ."""
    assert graph.information is not None
    turned = rotations.multiply(rotations.multiply(axes, graph.target_from_source), rotations.inverse(axes))
    information = rotations.turn_form(axes.expand(graph.num_edges, 4), graph.information)
    return replace(graph, target_from_source=rotations.canonical(turned), information=information)


@settings(max_examples=1)
@given(st.integers(0, 2**16))
def test_the_cameras_axes_do_not_matter(seed: int) -> None:
    graph, truth = _drawn(seed)
    expected = _solved(graph)
    error = orientation_errors(expected.body_from_world, truth)
    frames = rotations.random(5, generator=torch.Generator().manual_seed(seed))
    frames[0] = torch.tensor([0.5, -0.5, 0.5, 0.5])  # ROS body axes
    for axes in frames[:, None]:
        found = _solved(_with_axes(graph, axes))
        turned = orientation_errors(found.body_from_world, rotations.multiply(axes, truth))
        for figure in (torch.mean, torch.median):
            assert float(figure(turned)) == pytest.approx(float(figure(error)), rel=0.01)
        _assert_same_flags(found.outlier_score, expected.outlier_score)


@settings(max_examples=10)
@given(st.integers(0, 2**16))
def test_the_canonical_form_turns_information_with_edges_and_axes(seed: int) -> None:
    """Σ eᵀ Ω e of every edge at the truth is the same in any description."""
    graph, truth = _drawn(seed, num_nodes=12, share=0.6)
    rng = np.random.default_rng(seed)
    axes = rotations.random(1, generator=torch.Generator().manual_seed(seed))
    described = _with_axes(graph.reverse_edges(torch.from_numpy(rng.random(graph.num_edges) < 0.5)), axes)
    form = CanonicalForm.of(described)
    squares = _squares(form.graph, form.canonical_orientations(rotations.multiply(axes, truth)))
    torch.testing.assert_close(squares[form.edge], _squares(graph, truth), rtol=1e-6, atol=1e-6)


def _squares(graph: ViewGraph, body_from_world: Tensor) -> Tensor:
    """Squared errors ``(M,)`` in units of what edges state."""
    assert graph.information is not None
    true = rotations.multiply(body_from_world[graph.target], rotations.inverse(body_from_world[graph.source]))
    error = rotations.log(rotations.multiply(graph.target_from_source, rotations.inverse(true)))
    return torch.einsum("mi,mij,mj->m", error, graph.information, error)


def test_copies_state_the_best_information_of_any() -> None:
    relative = Rotation.random(3, random_state=0).as_quat()
    stated = [np.diag([1.0, 2.0, 3.0]), np.full((3, 3), np.nan), np.diag([2.0, 9.0, 4.0]), np.diag([5.0, 1.0, 2.0])]
    graph = ViewGraph.create([0, 1, 0, 2], [1, 2, 1, 0], relative[[0, 1, 0, 2]], information=np.stack(stated))
    is_reversed = torch.tensor([False, False, True, False])
    best = graph.information
    assert best is not None
    for described in (graph, graph.reverse_edges(is_reversed), graph.reverse_edges(~is_reversed)):
        for order in ([0, 1, 2, 3], [2, 3, 1, 0]):
            form = CanonicalForm.of(described.select_edges(torch.tensor(order)), own_axes=False)
            assert form.graph.num_edges == 3 and form.graph.information is not None
            place = [int(form.edge[order.index(number)]) for number in range(4)]
            assert place[0] == place[2]
            assert bool(form.graph.information[place[1]].isnan().all())
            found = form.graph.reverse_edges(form.graph.target == form.node.argsort()[0]).information
            assert found is not None
            torch.testing.assert_close(
                torch.linalg.eigvalsh(found[place[0]]), torch.linalg.eigvalsh(best[2]), atol=1e-9, rtol=0
            )


def _framed(rng: np.random.Generator, information: Tensor, exponent: float) -> FramedResiduals:
    """Normal residuals whose covariance is a power of what edges state, a tenth of them anything."""
    count = len(information)
    value, axes = torch.linalg.eigh(information)
    deviation = value ** (-exponent / 2)
    deviation = 0.02 * deviation / deviation.square().mean(dim=1, keepdim=True).sqrt()
    standard = torch.from_numpy(rng.standard_normal((count, 3, 1)))
    vector = (axes @ (deviation[:, :, None] * standard)).squeeze(2)
    wrong = torch.from_numpy(rng.random(count) < 0.1)
    vector[wrong] = torch.from_numpy(Rotation.random(int(wrong.sum()), rng).as_rotvec())
    turn = torch.from_numpy(Rotation.random(count, rng).as_matrix())
    return FramedResiduals(vector, turn, torch.zeros(count, dtype=torch.int64), torch.tensor([count - 100]))


def _random_information(rng: np.random.Generator, count: int) -> Tensor:
    axes = torch.from_numpy(Rotation.random(count, rng).as_matrix())
    return (axes * torch.from_numpy(np.exp(rng.normal(0, 1.2, (count, 1, 3))))) @ axes.mT


@settings(max_examples=6)
@given(st.integers(0, 2**16), st.sampled_from([0.0, 0.5, 1.0]))
def test_the_exponent_is_found(seed: int, exponent: float) -> None:
    rng = np.random.default_rng(seed)
    information = _random_information(rng, 2000)
    units = believed_units(information, _framed(rng, information, exponent), SHAPE)
    if exponent == 0:
        assert units is None
        return
    assert units is not None
    found, stated = (
        torch.linalg.eigvalsh(matrix).log().std(dim=1).mean() for matrix in (units.permute(2, 0, 1), information)
    )
    assert float(2 * found / stated) == pytest.approx(exponent, abs=0.15)
    covariance = torch.linalg.inv(units.permute(2, 0, 1) @ units.permute(2, 0, 1))
    torch.testing.assert_close(covariance.diagonal(dim1=1, dim2=2).mean(dim=1), torch.ones(2000).double())


def test_each_component_is_believed_by_itself() -> None:
    rng = np.random.default_rng(0)
    information = _random_information(rng, 1500)
    true, false = _framed(rng, information[:800], 1.0), _framed(rng, information[800:], 0.0)
    both = FramedResiduals(
        torch.cat((true.vector, false.vector)),
        torch.cat((true.source_from_target, false.source_from_target)),
        torch.tensor([0] * 800 + [2] * 700),
        torch.tensor([700, 0, 600]),
    )
    together, alone = believed_units(information, both, SHAPE), believed_units(information[:800], true, SHAPE)
    assert together is not None and alone is not None
    torch.testing.assert_close(together[:, :, :800], alone, atol=1e-3, rtol=0)
    unit = torch.eye(3, dtype=torch.float64)[:, :, None].expand(3, 3, 700)
    assert torch.equal(together[:, :, 800:], unit)


def test_nothing_is_believed_where_nothing_checks_or_is_stated() -> None:
    rng = np.random.default_rng(0)
    information = _random_information(rng, 300)
    residuals = _framed(rng, information, 1.0)
    assert believed_units(information, residuals._replace(redundancy=torch.tensor([0])), SHAPE) is None
    assert believed_units(information * torch.nan, residuals, SHAPE) is None
    round_ones = torch.eye(3, dtype=torch.float64).expand(300, 3, 3) * torch.rand(300, 1, 1)
    assert believed_units(round_ones, residuals, SHAPE) is None


@pytest.mark.parametrize("is_factorised", [False, True])
def test_systems_are_numpys_least_squares(is_factorised: bool) -> None:
    graph, _ = _drawn(0, num_nodes=20)
    graph = replace(graph, num_nodes=21)  # the last node has no edge
    rng = np.random.default_rng(2)
    factors = rng.standard_normal((graph.num_edges, 3, 3))
    weight = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(3)
    dense = np.zeros((21, 3, 21, 3))
    for u, v, block in zip(graph.source, graph.target, weight, strict=True):
        for row, column, sign in ((u, u, 1), (v, v, 1), (u, v, -1), (v, u, -1)):
            dense[row, :, column] += sign * block
    total = torch.from_numpy(rng.uniform(0.1, 10, graph.num_edges))
    weights = MatrixWeights(distinct_entries(torch.from_numpy(weight).permute(1, 2, 0)), total)
    system = EdgeLaplacian(Arrivals(SortedEdges.of(graph)), weights, graph.components())
    x = torch.from_numpy(rng.standard_normal((3, 21)))
    force = np.einsum("uivj,jv->iu", dense, x.numpy())
    np.testing.assert_allclose(system.product(x), force, atol=1e-9)
    by_node = total.new_zeros(21).index_add_(0, graph.source, total).index_add_(0, graph.target, total)
    torch.testing.assert_close(system.weight_sum, by_node)
    roots = torch.tensor([0, 20])
    mean_weight = torch.from_numpy(np.trace(weight, axis1=1, axis2=2) / 3)
    precondition = factorised(graph, mean_weight, roots) if is_factorised else system.diagonal_solve()
    found, is_solved = system.solve(torch.from_numpy(force), precondition, 1e-12, 0.0)
    assert is_solved is None
    torch.testing.assert_close((found - found[:, :1])[:, :20], (x - x[:, :1])[:, :20], atol=1e-8, rtol=0)


def test_graphs_solved_together_are_those_solved_alone() -> None:
    """But for where the steps of both end; what the one states changes nothing in the other."""
    with_some, other = _drawn(1)[0], _drawn(2)[0]
    nothing = replace(other, information=None, precision=other.precision * torch.nan)
    for second in (other, replace(other, information=None), nothing):
        graphs = [with_some, second]
        for graph, found in zip(graphs, solve_batch(graphs, profile="sfm"), strict=True):
            difference = orientation_errors(found.body_from_world, _solved(graph).body_from_world)
            assert float(torch.rad2deg(difference).max()) < 0.1
