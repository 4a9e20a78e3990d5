"""``solve`` as a user calls it: exactness, robustness, symmetries, mistakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import METHODS, EdgeKind, EdgeLabel, UserError, ViewGraph, rotations, solve
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.ground_truth import attach_truth
from rotavg_ros.datasets.simulation.false_closures import replace_closures
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.metrics import orientation_errors

from .graphs import as_quaternions, measured, random_truth, slam_edges, small_noise


def _max_error_deg(graph: ViewGraph, truth: Rotation, **options: object) -> float:
    solution = solve(graph, **options)  # type: ignore[arg-type]
    errors = orientation_errors(solution.body_from_world, as_quaternions(truth), solution.component)
    return float(torch.rad2deg(errors.max()))


def _slam_graph(seed: int, false_share: float = 0.3, planar: bool = False) -> tuple[ViewGraph, Rotation, np.ndarray]:
    """300 keyframes, 200 closures; odometry 0.3°, closures 1°."""
    source, target, kind = slam_edges(300, 200, seed)
    truth = random_truth(300, seed, planar)
    noise = small_noise(len(source), np.where(kind == 0, 0.3, 1.0), seed, planar).as_quat()
    false = (np.random.default_rng(seed + 1).random(len(source)) < false_share) & (kind == 1)
    angle = np.random.default_rng(seed + 2).uniform(0.3, np.pi, (int(false.sum()), 1))
    random = Rotation.random(int(false.sum()), random_state=seed)
    noise[false] = Rotation.from_rotvec(angle * [0, 0, 1]).as_quat() if planar else random.as_quat()
    return measured(truth, source, target, Rotation.from_quat(noise), kind=kind), truth, false


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("method", ["neurora", "spt"])
def test_exact_slam_graphs_are_solved_exactly(method: str, planar: bool) -> None:
    source, target, kind = slam_edges(200, 60, 0)
    truth = random_truth(200, 1, planar)
    assert _max_error_deg(measured(truth, source, target, kind=kind), truth, method=method) < 1e-4


@given(st.integers(0, 10**6))
@settings(max_examples=10)
def test_exact_sfm_graphs_are_solved_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = np.concatenate((np.arange(39), rng.integers(0, 40, 200)))
    target = np.concatenate((np.arange(1, 40), (source[39:] + rng.integers(1, 40, 200)) % 40))
    truth = random_truth(40, seed)
    assert _max_error_deg(measured(truth, source, target), truth, method="spt") < 1e-4
    # CleanNet expects noise, and sees some; but the measurements as they are fit themselves better. FineNet corrects in
    # units of at least NUMBERS.min_residual, 0.011°.
    assert _max_error_deg(measured(truth, source, target), truth, method="neurora-v1") < 0.02
    assert _max_error_deg(measured(truth, source, target), truth, refinement_steps=20) < 0.01


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_false_closures_are_found_and_do_no_harm(seed: int, planar: bool) -> None:
    graph, truth, false = _slam_graph(seed, planar=planar)
    solution = solve(graph)
    quaternion = as_quaternions(truth)
    error = float(torch.rad2deg(orientation_errors(solution.body_from_world, quaternion).mean()))
    without = solve(graph.select_edges(torch.from_numpy(~false)), refinement_steps=1)
    oracle = float(torch.rad2deg(orientation_errors(without.body_from_world, quaternion).mean()))
    assert error < 1.3 * oracle + 0.02
    flagged = (solution.outlier_score > 0.5).numpy()
    assert (flagged & false).sum() >= 0.95 * false.sum()
    assert (flagged & ~false).sum() <= 0.02 * len(false)


def test_the_answer_does_not_depend_on_the_order_or_direction_of_edges() -> None:
    graph, _, _ = _slam_graph(3)
    solution = solve(graph)
    rng = np.random.default_rng(0)
    order = torch.from_numpy(rng.permutation(graph.num_edges))
    turned = torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    shuffled = graph.select_edges(order)
    inverted = ViewGraph.create(
        torch.where(turned, shuffled.target, shuffled.source),
        torch.where(turned, shuffled.source, shuffled.target),
        torch.where(turned[:, None], rotations.inverse(shuffled.target_from_source), shuffled.target_from_source),
        kind=shuffled.kind,
    )
    other = solve(inverted)
    assert float(rotations.angle_between(other.body_from_world, solution.body_from_world).max()) < np.radians(0.01)
    torch.testing.assert_close(other.outlier_score, solution.outlier_score[order], atol=2e-3, rtol=0)


def test_a_turned_world_turns_nothing_else() -> None:
    """Relative rotations know no world frame, so the answer, rooted at the first node, is the same to the bit."""
    graph, truth, _ = _slam_graph(4)
    turn = Rotation.random(random_state=5)
    relative = (truth * turn)[graph.target.numpy()] * (truth * turn)[graph.source.numpy()].inv()
    same = truth[graph.target.numpy()] * truth[graph.source.numpy()].inv()
    np.testing.assert_allclose(relative.as_quat(canonical=True), same.as_quat(canonical=True), atol=1e-12)
    solution = solve(graph)
    assert float(rotations.angle(solution.body_from_world[0])) < 1e-12


def test_components_are_solved_separately() -> None:
    """But for the noise, of which twice as much is known."""
    graph, _, _ = _slam_graph(6)
    first = solve(graph)
    joined = ViewGraph.create(
        torch.cat((graph.source, graph.source + 300)),
        torch.cat((graph.target, graph.target + 300)),
        torch.cat((graph.target_from_source, graph.target_from_source)),
        num_nodes=601,
        kind=torch.cat((graph.kind, graph.kind)),
    )
    second = solve(joined)
    assert second.component.tolist() == [0] * 300 + [1] * 300 + [2]
    for half in (second.body_from_world[:300], second.body_from_world[300:600]):
        assert float(rotations.angle_between(half, first.body_from_world).max()) < np.radians(1.0)
    assert torch.isfinite(second.body_from_world).all()


@pytest.mark.parametrize("profile", ["slam", "sfm"])
def test_labels_overrule_the_solver(profile: str) -> None:
    graph, _, false = _slam_graph(7)
    label = torch.full((graph.num_edges,), int(EdgeLabel.AUTOMATIC))
    rejected, accepted = int(np.flatnonzero(false)[0]), int(np.flatnonzero(~false)[250])
    label[rejected], label[accepted] = EdgeLabel.REJECTED, EdgeLabel.ACCEPTED
    solution = solve(replace(graph, label=label), profile=profile)
    assert solution.outlier_score[rejected] == 1 and solution.outlier_score[accepted] == 0


def test_an_accepted_closure_bends_the_graph() -> None:
    source, target, kind = slam_edges(50, 0, 0)
    truth = random_truth(50, 0)
    turn = Rotation.from_rotvec([0, 0, 1.0])
    relative = truth[target] * truth[source].inv()
    wrong = truth[49] * truth[0].inv() * turn
    graph = ViewGraph.create(
        np.append(source, 0),
        np.append(target, 49),
        np.vstack((relative.as_quat(), wrong.as_quat())),
        kind=np.append(kind, EdgeKind.LOOP_CLOSURE),
        label=[EdgeLabel.AUTOMATIC] * 49 + [EdgeLabel.ACCEPTED],
    )
    solution = solve(graph)
    last = solution.body_from_world[49]
    assert float(rotations.angle_between(last, torch.from_numpy(wrong.as_quat()))) < np.radians(5)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("profile", ["slam", "sfm"])
@pytest.mark.parametrize("num_nodes", [0, 1, 2, 3])
def test_tiny_graphs(method: str, profile: str, num_nodes: int) -> None:
    source = np.arange(max(num_nodes - 1, 0))
    truth = Rotation.random(max(num_nodes, 1), random_state=0)
    relative = (truth[source + 1] * truth[source].inv()).as_quat() if len(source) else np.empty((0, 4))
    graph = ViewGraph.create(source, source + 1, relative, num_nodes=num_nodes, kind=np.zeros(len(source)))
    solution = solve(graph, method=method, profile=profile)
    assert solution.body_from_world.shape == (num_nodes, 4)
    assert torch.isfinite(solution.body_from_world).all() and torch.isfinite(solution.outlier_score).all()


def test_stages_follow_the_method() -> None:
    graph, _, _ = _slam_graph(8)
    assert list(solve(graph).stage_seconds) == ["refine", "expand"]
    for without_search in ({"refinement_steps": 0}, {"method": "cleannet-spt"}):
        assert list(solve(graph, **without_search).stage_seconds) == ["contract", "clean", "bootstrap", "expand"]
    paper = solve(graph, profile="sfm", method="neurora-v1").stage_seconds
    assert list(paper) == ["order", "clean", "cycles", "bootstrap", "fine-tune"]
    whole = solve(graph, profile="sfm").stage_seconds
    refined = ["refine", "consensus", "attach", "uncertainty"]
    assert list(whole) == ["order", "clean", "cycles", "bootstrap", "fine-tune", *refined]
    for without_cycles in ("spt", "neurora-paper", "neurora-without-cycles"):
        assert "cycles" not in solve(graph, profile="sfm", method=without_cycles).stage_seconds


@pytest.mark.parametrize("profile", ["slam", "sfm"])
def test_combinations_start_from_the_answer_before(profile: str) -> None:
    graph = PaperRecipe(cameras=(30, 30)).sample(np.random.default_rng(0)).graph
    first = solve(graph, method="chatterjee", profile=profile)
    joined = solve(graph, method="chatterjee+weiszfeld", profile=profile)
    by_hand = solve(graph, method="weiszfeld", profile=profile, warm_start=first.body_from_world)
    assert list(joined.stage_seconds) == ["chatterjee", "weiszfeld"]
    assert joined.method == "chatterjee+weiszfeld"
    assert float(rotations.angle_between(joined.body_from_world, by_hand.body_from_world).max()) < 1e-6


def test_a_warm_start_ends_where_the_cold_one_does() -> None:
    graph, _, _ = _slam_graph(9)
    cold = solve(graph)
    warm = solve(graph, warm_start=cold.body_from_world)
    assert float(rotations.angle_between(warm.body_from_world, cold.body_from_world).max()) < np.radians(0.05)


@pytest.mark.parametrize("recipe", [ReleasedRecipe(cameras=(150, 150)), PaperRecipe(cameras=(150, 150))])
def test_the_networks_beat_the_tree(recipe: ReleasedRecipe | PaperRecipe) -> None:
    """Mean and median error, and accuracy of the flags, of every stage on graphs that no network has seen."""
    rows = {}
    for method in ("spt", "cleannet-spt", "neurora-v1", "neurora"):
        of_method = []
        for seed in range(3):
            sample = recipe.sample(np.random.default_rng((99, seed)))
            solution = solve(sample.graph, method=method)
            error = torch.rad2deg(orientation_errors(solution.body_from_world, sample.body_from_world))
            right = (solution.outlier_score > 0.5) == sample.is_outlier
            of_method.append([float(error.mean()), float(error.median()), float(right.double().mean())])
        rows[method] = np.mean(of_method, axis=0)
    mean, median, accuracy = ({method: row[column] for method, row in rows.items()} for column in range(3))
    assert mean["cleannet-spt"] < 0.7 * mean["spt"]
    assert mean["neurora-v1"] < 0.85 * mean["cleannet-spt"]
    assert median["neurora"] < median["neurora-v1"] < 0.6 * median["cleannet-spt"]
    assert accuracy["neurora"] > accuracy["cleannet-spt"] < accuracy["neurora-v1"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "unknown method 'magic'; choose from neurora"),
        ({"method": "spt+magic"}, "unknown method 'magic'; choose from neurora"),
        ({"method": "spt+"}, "unknown method ''; choose from neurora"),
        ({"profile": "drone"}, "unknown profile 'drone'"),
        ({"device": "tpu"}, "unknown device 'tpu'"),
        ({"refinement_steps": -1}, "must not be negative"),
        ({"work": -1.0}, "work must be a number of units"),
        ({"work": float("nan")}, "work must be a number of units"),
        ({"warm_start": torch.zeros(3, 4)}, r"the warm start has shape \(3, 4\)"),
        ({"warm_start": torch.full((300, 4), torch.nan)}, "the warm start's row 0 has length nan; give unit quat"),
        ({"warm_start": torch.ones(300, 4)}, "the warm start's row 0 has length 2; give unit quaternions"),
    ],
)
def test_mistakes_are_one_line(options: dict[str, object], message: str) -> None:
    graph, _, _ = _slam_graph(10)
    with pytest.raises(UserError, match=message) as error:
        solve(graph, **options)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


@pytest.mark.large
@pytest.mark.parametrize(("name", "odometry_deg"), [("sphere2500", 47.0), ("manhattan", 24.2)])
def test_classic_graphs_with_thirty_percent_false_closures(shared_data: Path, name: str, odometry_deg: float) -> None:
    folder = shared_data / "slam"
    graph_file = attach_truth(read_graph(folder / f"{name}.g2o"), folder / f"{name}_ground_truth.csv")
    assert graph_file.body_from_world_gt is not None
    spoiled = replace_closures(graph_file, graph_file.body_from_world_gt, 0.3, np.random.default_rng(5))
    solution = solve(spoiled.graph_file.graph)
    truth = torch.from_numpy(graph_file.body_from_world_gt)
    error = float(torch.rad2deg(orientation_errors(solution.body_from_world, truth)).mean())
    assert error < 0.15 * odometry_deg


@pytest.mark.large
def test_the_stated_uncertainty_is_that_of_repeated_runs() -> None:
    """Root mean square error over draws of the noise, against what each solve says of itself, inside segments too."""
    source, target, kind = slam_edges(300, 60, 3)
    truth = random_truth(300, 3)
    squares, stated = [], []
    for seed in range(30):
        noise = small_noise(len(source), np.where(kind == 0, 0.5, 1.0), 1000 + seed)
        solution = solve(measured(truth, source, target, noise, kind=kind))
        root = rotations.multiply(as_quaternions(truth), rotations.inverse(as_quaternions(truth)[0]))
        error = rotations.log(rotations.multiply(rotations.inverse(root), solution.body_from_world))
        squares.append((error**2).mean(dim=1))
        stated.append(solution.uncertainty**2)
    ratio = (torch.stack(squares).mean(0)[1:] / torch.stack(stated).mean(0)[1:]).sqrt()
    assert 0.8 < float(ratio.median()) < 1.2
    assert float(ratio.min()) > 0.5 and float(ratio.max()) < 2


@pytest.mark.parametrize("profile", ["slam", "sfm"])
@pytest.mark.parametrize("method", ["neurora", "spt", "chatterjee"])
@pytest.mark.parametrize("num_edges", [0, 3, 4])
def test_a_node_without_edges_is_certain_relative_to_itself(profile: str, method: str, num_edges: int) -> None:
    """It is its component's first node, whatever the method states of others, and whatever the rest of the graph is."""
    source, target = torch.tensor([0, 1, 2, 0])[:num_edges], torch.tensor([1, 2, 3, 3])[:num_edges]
    kind = torch.tensor([0, 0, 0, 1])[:num_edges]
    graph = ViewGraph.create(source, target, rotations.identity(num_edges), num_nodes=6, kind=kind)
    assert solve(graph, profile=profile, method=method).uncertainty[4:].tolist() == [0.0, 0.0]
