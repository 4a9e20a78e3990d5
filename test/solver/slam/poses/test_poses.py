"""Orientations and positions together: against gtsam on the whole graph, and in whatever unit, order and direction."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.slam import stress
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.metrics.positions import position_errors
from rotavg_ros.solver import Solution, solve
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.publishing.answer import Poses, answer
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.solve import search
from rotavg_ros.solver.slam.stages import bootstrap
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

HILLS = {"dimensions": 3, "terrain_tilt_deg": 10.0, "sway_deg": 3.0}


def simulated(seed: int = 0, **options: object) -> SimulatedRun:
    config = {"num_keyframes": 400, "laps": 3.0, "closures_per_keyframe": 0.15, "false_share": 0.0} | options
    return simulate_slam_graph(SlamSimulationConfig(**config), np.random.default_rng(seed))


def graph_of(run: SimulatedRun) -> ViewGraph:
    return replace(run.graph, translation=torch.from_numpy(run.edge_translation))


def held_by_gravity(run: SimulatedRun, yaw_deg: float, seed: int = 0) -> ViewGraph:
    """The same, but that odometry errs about the vertical alone, by so many degrees a step."""
    graph, rng = graph_of(run), np.random.default_rng(seed)
    steps = graph.is_odometry.numpy()
    world_from_body = Rotation.from_quat(run.world_from_body)
    source, target = graph.source.numpy()[steps], graph.target.numpy()[steps]
    up = world_from_body[target].inv().apply([0.0, 0.0, 1.0])
    noise = Rotation.from_rotvec(np.radians(yaw_deg) * rng.normal(size=(len(up), 1)) * up)
    turn = graph.target_from_source.clone()
    turn[graph.is_odometry] = torch.from_numpy(
        (noise * world_from_body[target].inv() * world_from_body[source]).as_quat()
    )
    return replace(graph, target_from_source=rotations.normalize(turn))


def errors(run: SimulatedRun, solution: Solution) -> tuple[float, float]:
    """Mean degrees and RMS metres."""
    truth = torch.from_numpy(Rotation.from_quat(run.world_from_body).inv().as_quat())
    degrees = torch.rad2deg(orientation_errors(solution.body_from_world, truth)).mean()
    assert solution.position is not None
    return float(degrees), float(np.sqrt((position_errors(solution.position.numpy(), run.position) ** 2).mean()))


@torch.no_grad()
def pose_mode(graph: ViewGraph, without: Collection[str] = ()) -> PoseMode:
    assert graph.translation is not None
    mode = search(graph, Networks("cpu").load(SlamCleanNet), bootstrap, without).modes[0]
    return estimate_poses(PoseProblem(graph, graph.translation.numpy(), mode))


def odometry_with_two_closures(kind: str, backward: bool) -> ViewGraph:
    """Of 150 keyframes; closures far from each other, since neighbours share an error, which gtsam is not told of."""
    run = simulated(
        **({} if kind == "plane" else HILLS),
        odometry_backward=backward,
        num_keyframes=150,
        closures_per_keyframe=0.1,
        odometry_noise_deg=0.3,
        closure_noise_deg=1.0,
    )
    graph = held_by_gravity(run, 0.3) if kind == "gravity" else graph_of(run)
    closure = np.flatnonzero(~graph.is_odometry.numpy())
    kept = graph.is_odometry.clone()
    kept[closure[:: len(closure) // 2]] = True
    return graph.select_edges(kept)


def told_to_gtsam(graph: ViewGraph, mode: PoseMode, found: Poses, held: int = 0) -> tuple[object, object]:
    """The whole graph with the noise of an answer, as gtsam's factors, one node held, and its poses to start from."""
    gtsam = pytest.importorskip("gtsam")
    problem, solved = mode.problem, mode.solved
    odometry, closures = graph.is_odometry.numpy(), mode.problem.mode.problem.closure
    assert problem.num_runs == 0
    # To gtsam a translation errs along the axes of the end that it is stated from; here, of the older one.
    graph = graph.reverse_edges(graph.source > graph.target)
    assert graph.translation is not None
    translation = graph.translation.numpy()
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    source, target = graph.source.numpy(), graph.target.numpy()
    turn = Rotation.from_quat(graph.target_from_source.numpy()).inv().as_matrix()
    rotation_sigma = np.full(graph.num_edges, np.sqrt(solved.state.noise.turn))
    length = np.linalg.norm(translation, axis=1)
    shift_sigma = np.sqrt(solved.state.noise.of_odometry(np.stack((length, np.ones_like(length)), axis=1)))
    edges = problem.drawn.view_graph_edge[closures - problem.drawn.num_segments]
    assert odometry.sum() + len(edges) == graph.num_edges
    rotation_sigma[edges] = solved.rotation_weight[closures, 0] ** -0.5
    shift_sigma[edges] = solved.closure_weight**-0.5
    world_from_body = Rotation.from_quat(found.body_from_world).inv()
    for node in range(graph.num_nodes):
        start.insert(node, gtsam.Pose3(gtsam.Rot3(world_from_body[node].as_matrix()), found.position[node]))
    about, other = problem.about_drift_axis, np.eye(problem.turns) - problem.about_drift_axis
    axes = about + np.sqrt(solved.state.noise.tilt / solved.state.noise.turn) * other
    for edge in range(graph.num_edges):
        covariance = np.diag(np.repeat([rotation_sigma[edge], shift_sigma[edge]], 3) ** 2)
        if problem.turns == 1:
            covariance[[0, 1, 5], [0, 1, 5]] = 1e-12  # neither tilts nor heaves
        elif odometry[edge]:
            # gtsam counts turns in the target's frame.
            errs = rotation_sigma[edge] * world_from_body[target[edge]].as_matrix().T @ axes
            covariance[:3, :3] = errs @ errs.T
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        measured = gtsam.Pose3(gtsam.Rot3(turn[edge]), translation[edge])
        factors.add(gtsam.BetweenFactorPose3(int(source[edge]), int(target[edge]), measured, noise))
    factors.add(gtsam.PriorFactorPose3(held, start.atPose3(held), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    return factors, start


def deviations(factors: object, best: object, problem: PoseProblem) -> np.ndarray:
    """``(2, N)`` gtsam's standard deviations of turns and positions, per component."""
    gtsam = pytest.importorskip("gtsam")
    marginals = gtsam.Marginals(factors, best)
    covariance = [marginals.marginalCovariance(node) for node in range(problem.graph.num_nodes)]
    square = np.diagonal(np.array(covariance), axis1=1, axis2=2)
    return np.sqrt([square[:, :3].sum(axis=1) / problem.turns, square[:, 3:].sum(axis=1) / problem.shifts])


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("kind", ["plane", "hills", "gravity"])
def test_what_is_drawn_together_is_the_whole_graphs_optimum(kind: str, backward: bool) -> None:
    """Every keyframe where gtsam puts it, by the same noise, from levers and bridges alone, and as uncertain."""
    gtsam = pytest.importorskip("gtsam")
    graph = odometry_with_two_closures(kind, backward)
    # gtsam is told one variance for all steps of odometry.
    mode = pose_mode(graph, without=("turns", "tails"))
    found, _ = answer([mode], np.ones(1))
    noise = mode.solved.state.noise
    assert (noise.tilt < 0.1 * noise.turn) == (kind == "gravity")
    factors, start = told_to_gtsam(graph, mode, found)
    best = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
    expected = [best.atPose3(node) for node in range(graph.num_nodes)]
    world_from_body = Rotation.from_quat(found.body_from_world).inv()
    off = (Rotation.from_matrix([pose.rotation().matrix() for pose in expected]).inv() * world_from_body).magnitude()
    apart = np.linalg.norm(np.array([pose.translation() for pose in expected]) - found.position, axis=1)
    drift = np.abs(world_from_body.magnitude()).max()
    assert drift > np.radians(10)
    assert np.degrees(off.max()) < 0.05 and apart.max() < 0.01
    assert len(mode.problem.drawn.nodes) < 0.1 * graph.num_nodes
    ours = np.sqrt([found.variance, found.position_variance])
    np.testing.assert_allclose(ours[:, 1:], deviations(factors, best, mode.problem)[:, 1:], rtol=0.02)


@pytest.mark.parametrize("where", ["inside", "at a closure"])
@pytest.mark.parametrize("kind", ["plane", "hills", "gravity"])
def test_uncertainty_is_relative_to_the_first_node(kind: str, where: str) -> None:
    """Whichever keyframe has the lowest number: gtsam's, with that one held."""
    gtsam = pytest.importorskip("gtsam")
    graph = odometry_with_two_closures(kind, backward=False)
    first = int(graph.target[~graph.is_odometry][-1]) if where == "at a closure" else 70
    number = torch.arange(graph.num_nodes)
    number[[0, first]] = number[[first, 0]]
    mode = pose_mode(replace(graph, source=number[graph.source], target=number[graph.target]), ("turns", "tails"))
    assert (number[first] in mode.problem.drawn.nodes) == (where == "at a closure")
    by_number, _ = answer([mode], np.ones(1))
    names = ("body_from_world", "position", "variance", "position_variance")
    found = replace(by_number, **{name: getattr(by_number, name)[number.numpy()] for name in names})
    factors, start = told_to_gtsam(graph, mode, found, first)
    best = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
    ours, theirs = np.sqrt([found.variance, found.position_variance]), deviations(factors, best, mode.problem)
    assert (ours[:, first] < 1e-6).all()
    others = np.arange(graph.num_nodes) != first
    np.testing.assert_allclose(ours[:, others], theirs[:, others], rtol=0.02)


@pytest.mark.large
@pytest.mark.parametrize("hills", [False, True])
def test_translations_make_orientations_better(hills: bool) -> None:
    gained = []
    for seed in range(4):
        run = simulated(seed, **(HILLS if hills else {}), false_share=0.3)
        together, metres = errors(run, solve(graph_of(run)))
        truth = torch.from_numpy(Rotation.from_quat(run.world_from_body).inv().as_quat())
        alone = torch.rad2deg(orientation_errors(solve(run.graph).body_from_world, truth)).mean()
        gained.append(np.log(together / float(alone)))
        assert metres < 0.3
    assert np.exp(np.mean(gained)) < 0.95


def displaced(run: SimulatedRun, share: float, seed: int) -> tuple[ViewGraph, np.ndarray]:
    """Parallel corridors: closures whose rotation is right join places 5–20 m from each other; and which these are."""
    draw = np.random.default_rng(seed)
    graph = graph_of(run)
    closure = np.flatnonzero(~graph.is_odometry.numpy())
    wrong = closure[draw.random(len(closure)) < share]
    direction = draw.normal(size=(len(wrong), 3)) * [1, 1, 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    translation = run.edge_translation.copy()
    translation[wrong] += direction * draw.uniform(5, 20, (len(wrong), 1))
    return replace(graph, translation=torch.from_numpy(translation)), np.isin(np.arange(graph.num_edges), wrong)


def test_right_rotation_wrong_place() -> None:
    found, flagged, right = 0, 0, 0
    for seed in range(4):
        run = simulated(seed)
        graph, is_wrong = displaced(run, 0.3, seed)
        solution = solve(graph)
        closure = ~graph.is_odometry.numpy()
        is_flagged = solution.outlier_score.numpy() > 0.5
        assert solution.rotation_score is not None
        assert (solution.rotation_score.numpy()[is_wrong] < 0.5).mean() > 0.9
        found += int((is_flagged & is_wrong).sum())
        flagged += int((is_flagged & closure).sum())
        right += int(is_wrong.sum())
        assert errors(run, solution)[1] < 0.3
    assert found >= 0.97 * right and found >= 0.98 * flagged


def test_a_corridor_mistaken_again_and_again() -> None:
    """One wrong place that many closures in a row agree on: neither odometry nor the rest is bent for it."""
    run = simulated(1)
    graph = graph_of(run)
    closure = np.flatnonzero(~graph.is_odometry.numpy())
    wrong = closure[20:32]
    assert run.graph.translation is None and graph.translation is not None
    world_from_source = Rotation.from_quat(run.world_from_body[graph.source.numpy()[wrong]])
    translation = run.edge_translation.copy()
    translation[wrong] += world_from_source.inv().apply([9.0, 4.0, 0.0])
    solution = solve(replace(graph, translation=torch.from_numpy(translation)))
    assert (solution.outlier_score.numpy()[wrong] > 0.5).all()
    assert errors(run, solution)[1] < 0.3


def as_answered(graph: ViewGraph) -> Solution:
    solution = solve(graph)
    assert solution.position is not None
    return solution


def same_orientations(a: Solution, b: Solution, degrees: float) -> None:
    off = torch.rad2deg(rotations.angle_between(a.body_from_world, b.body_from_world))
    assert float(off.max()) < degrees


def test_the_unit_of_length_does_not_matter() -> None:
    run = simulated(2, false_share=0.3)
    graph = graph_of(run)
    assert graph.translation is not None
    first, second = as_answered(graph), as_answered(replace(graph, translation=graph.translation * 20))
    same_orientations(first, second, 1e-6)
    assert first.position is not None and second.position is not None
    torch.testing.assert_close(first.position * 20, second.position, rtol=1e-6, atol=1e-6)


def test_the_order_of_edges_does_not_matter() -> None:
    graph = graph_of(simulated(3, false_share=0.3))
    order = torch.from_numpy(np.random.default_rng(0).permutation(graph.num_edges))
    first, second = as_answered(graph), as_answered(graph.select_edges(order))
    same_orientations(first, second, 1e-6)
    torch.testing.assert_close(first.outlier_score[order], second.outlier_score, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "kind",
    [
        "lone slip: 5 witnesses, three",
        *(pytest.param(kind, marks=pytest.mark.large) for kind in ("2 robots", "grid: gyroscope bias")),
    ],
)
def test_the_direction_of_edges_does_not_matter(kind: str) -> None:
    """A translation errs along the axes of the older end, from whichever end it is stated."""
    graph = next(drawings(stress.kinds((kind,), translations=True), [1])).graph
    turned = torch.from_numpy(np.random.default_rng(2).random(graph.num_edges) < 0.5)
    first, second = as_answered(graph), as_answered(graph.reverse_edges(turned))
    same_orientations(first, second, 1e-6)
    torch.testing.assert_close(first.outlier_score, second.outlier_score, rtol=1e-6, atol=1e-6)
    assert first.position is not None and second.position is not None
    torch.testing.assert_close(first.position, second.position, rtol=1e-6, atol=1e-6)


def test_without_translations_nothing_changes() -> None:
    run = simulated(5, false_share=0.3)
    plain = solve(run.graph)
    assert plain.position is None and plain.rotation_score is None
    for useless in (
        torch.full((run.graph.num_edges, 3), torch.nan),
        torch.zeros((run.graph.num_edges, 3)),
        torch.where(run.graph.is_odometry[:, None], torch.nan, torch.from_numpy(run.edge_translation)),
        torch.where(run.graph.is_odometry[:, None], torch.from_numpy(run.edge_translation), torch.nan),
    ):
        solution = solve(replace(run.graph, translation=useless.double()))
        assert solution.position is None
        assert torch.equal(solution.body_from_world, plain.body_from_world)
        assert torch.equal(solution.outlier_score, plain.outlier_score)


def test_closures_without_a_translation_are_judged_by_their_rotation() -> None:
    run = simulated(6, false_share=0.3)
    graph = graph_of(run)
    assert graph.translation is not None
    unknown = ~graph.is_odometry & (torch.arange(graph.num_edges) % 3 == 0)
    solution = as_answered(replace(graph, translation=torch.where(unknown[:, None], torch.nan, graph.translation)))
    score, is_false = solution.outlier_score.numpy() > 0.5, run.closure_is_false
    assert (score == is_false)[unknown.numpy()].mean() > 0.9
    assert solution.rotation_score is not None
    assert torch.equal(solution.rotation_score[unknown] > 0.5, solution.outlier_score[unknown] > 0.5)


def test_a_closure_without_a_translation_may_be_long() -> None:
    """Nothing tells where it leads, so metres between its ends say nothing."""
    run = simulated(12, closure_radius_m=6.0)
    graph = graph_of(run)
    assert graph.translation is not None
    unknown = ~graph.is_odometry & (torch.arange(graph.num_edges) % 2 == 0)
    solution = as_answered(replace(graph, translation=torch.where(unknown[:, None], torch.nan, graph.translation)))
    assert solution.position is not None
    apart = (solution.position[graph.source] - solution.position[graph.target]).norm(dim=1)
    assert (unknown & (apart > 2.5)).sum() > 3
    assert (solution.outlier_score[unknown] < 0.5).all()


def test_rejected_odometry_beside_the_chain_does_not_pull() -> None:
    run = simulated(13)
    graph = graph_of(run)
    assert graph.translation is not None
    wrong = ViewGraph.create(
        torch.cat((graph.source, torch.tensor([50]))),
        torch.cat((graph.target, torch.tensor([60]))),
        torch.cat((graph.target_from_source, torch.tensor([[0.0, 0.0, 0.7, 0.714142842854285]]).double())),
        kind=torch.cat((graph.kind, torch.tensor([int(EdgeKind.ODOMETRY)]))),
        label=torch.cat((graph.label, torch.tensor([int(EdgeLabel.REJECTED)]))),
        translation=torch.cat((graph.translation, torch.tensor([[30.0, 0.0, 0.0]]).double())),
    )
    first, second = as_answered(graph), as_answered(wrong)
    same_orientations(first, second, 0.2)
    assert first.position is not None and second.position is not None
    assert (first.position - second.position).norm(dim=1).max() < 0.05


def test_labels_decide() -> None:
    run = simulated(7)
    graph, is_wrong = displaced(run, 0.3, 7)
    wrong = int(np.flatnonzero(is_wrong)[0])
    right = int(np.flatnonzero(~is_wrong & ~graph.is_odometry.numpy())[0])
    label = graph.label.clone()
    label[wrong], label[right] = EdgeLabel.ACCEPTED, EdgeLabel.REJECTED
    solution = as_answered(replace(graph, label=label))
    assert solution.rotation_score is not None
    assert solution.outlier_score[wrong] == 0.0 and solution.outlier_score[right] == 1.0
    before = as_answered(graph).outlier_score
    same = ((solution.outlier_score > 0.5) == (before > 0.5)).numpy()
    assert set(np.flatnonzero(~same)) <= {wrong, right}


@pytest.mark.parametrize(("with_places", "height", "tilt"), [(True, 1e-4, 0.0), (True, 0.0, 0.01), (False, 0.0, 0.01)])
def test_a_rejected_closure_off_the_plane_changes_nothing(with_places: bool, height: float, tilt: float) -> None:
    """All else is in a plane, and so is the answer, as certain as before."""
    graph = graph_of(simulated(0, num_keyframes=200))
    assert graph.translation is not None
    closure = int(np.flatnonzero(~graph.is_odometry.numpy())[5])
    label, shift, turn = graph.label.clone(), graph.translation.clone(), graph.target_from_source.clone()
    label[closure] = EdgeLabel.REJECTED
    shift[closure, 2] += height
    turn[closure] = rotations.multiply(rotations.exp(torch.tensor([tilt, 0.0, 0.0]).double()), turn[closure])
    off = replace(graph, label=label, translation=shift, target_from_source=rotations.canonical(turn))
    expected, found = (
        solve(each if with_places else replace(each, translation=None)) for each in (replace(graph, label=label), off)
    )
    same_orientations(expected, found, 0.05)
    torch.testing.assert_close(found.uncertainty[1:], expected.uncertainty[1:], rtol=0.01, atol=0)
    if expected.position is not None and found.position is not None:
        assert (expected.position - found.position).norm(dim=1).max() < 0.001
        assert expected.position_uncertainty is not None and found.position_uncertainty is not None
        torch.testing.assert_close(found.position_uncertainty[1:], expected.position_uncertainty[1:], rtol=0.01, atol=0)


def test_repeated_edges_count_once() -> None:
    graph = graph_of(simulated(8, false_share=0.2))
    twice = torch.cat((torch.arange(graph.num_edges), torch.arange(graph.num_edges // 3)))
    first, second = as_answered(graph), as_answered(graph.select_edges(twice))
    same_orientations(first, second, 1e-9)
    assert first.rotation_score is not None and second.rotation_score is not None
    torch.testing.assert_close(first.rotation_score[twice], second.rotation_score)


def test_components_lie_at_their_own_origins() -> None:
    run = simulated(9)
    graph = graph_of(run)
    assert graph.translation is not None
    two = ViewGraph.create(
        torch.cat((graph.source, graph.source + graph.num_nodes)),
        torch.cat((graph.target, graph.target + graph.num_nodes)),
        torch.cat((graph.target_from_source, graph.target_from_source)),
        kind=torch.cat((graph.kind, graph.kind)),
        translation=torch.cat((graph.translation, graph.translation)),
    )
    solution = as_answered(two)
    assert solution.position is not None and solution.position_uncertainty is not None
    first, second = solution.position.split(graph.num_nodes)
    assert torch.equal(first[0], torch.zeros(3).double()) and torch.equal(second[0], torch.zeros(3).double())
    torch.testing.assert_close(first, second, rtol=0, atol=0.05)
    assert solution.position_uncertainty[0] < 1e-3 < float(solution.position_uncertainty.median()) < 1.0


def test_robots_that_closures_alone_join() -> None:
    run = simulated(10, num_keyframes=400)
    graph = graph_of(run)
    assert graph.translation is not None
    cut = graph.is_odometry & (torch.minimum(graph.source, graph.target) == 200)
    parted = graph.select_edges(~cut)
    solution = as_answered(parted)
    assert len(solution.component.unique()) == 1
    truth = torch.from_numpy(Rotation.from_quat(run.world_from_body).inv().as_quat())
    assert float(torch.rad2deg(orientation_errors(solution.body_from_world, truth)).mean()) < 2.0
    assert solution.position is not None
    assert np.sqrt((position_errors(solution.position.numpy(), run.position) ** 2).mean()) < 0.3


def test_what_is_stated_covers_the_error() -> None:
    turns, shifts = [], []
    for seed in range(30, 38):
        run = simulated(seed, false_share=0.2)
        solution = as_answered(graph_of(run))
        assert solution.position is not None and solution.position_uncertainty is not None
        truth = Rotation.from_quat(run.world_from_body)
        mine = Rotation.from_quat(solution.world_from_body.numpy())
        off = ((truth[0].inv() * truth).inv() * (mine[0].inv() * mine)).magnitude()
        turns.append((off <= 2 * solution.uncertainty.numpy() + 1e-6).mean())
        position = truth[0].inv().apply(run.position - run.position[0])
        apart = np.abs(solution.position.numpy() - position)[:, :2]
        shifts.append((apart <= 2 * solution.position_uncertainty.numpy()[:, None] + 1e-9).mean())
    assert np.mean(turns) > 0.85 and np.mean(shifts) > 0.85


def test_kinds_of_edges_are_kept() -> None:
    """A sound graph: nothing is flagged, and odometry's slips stay slips."""
    graph = graph_of(simulated(11))
    solution = as_answered(graph)
    assert (solution.outlier_score[graph.kind == EdgeKind.LOOP_CLOSURE] < 0.5).all()
    assert (solution.outlier_score[graph.is_odometry] < 0.1).all()
