"""Odometry whose position jumps while its heading does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.simulation.poses.odometry_jumps import STEPS
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun
from rotavg_ros.evaluation.common.cases import Case
from rotavg_ros.evaluation.slam import pose_cases
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.slam.poses.search import jumps, rivals
from rotavg_ros.solver.slam.poses.search.jump_witnesses import Jump, Witnesses
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import EdgeLabel

from .test_pose_memory import go_on, up_to
from .test_poses import HILLS, errors, graph_of, simulated


def case_of(kind: str, seed: int) -> Case:
    (case,) = (one.draw(seed) for one in pose_cases.kinds(Path, [kind]) if one.name == kind)
    assert case is not None
    return case


def errors_of(case: Case, solution: Solution) -> tuple[float, float]:
    """Mean of orientations, degrees, and of positions, metres, the first keyframe's pose given."""
    assert case.poses is not None and solution.position is not None
    turned = np.degrees(orientation_errors(solution.body_from_world, case.truth).numpy().mean())
    frame = rotations.multiply(rotations.inverse(case.truth[0]), solution.body_from_world[0])
    placed = rotations.rotate(frame.expand(len(case.truth), 4), solution.position - solution.position[0])
    return float(turned), float((placed - (case.poses.position - case.poses.position[0])).norm(dim=1).mean())


def warned_of_jumps(solution: Solution) -> list[str]:
    return [warning for warning in solution.warnings if "seems to have jumped" in warning]


def jumped(graph: ViewGraph, step: int, shift: tuple[float, float, float]) -> ViewGraph:
    """With one step of odometry off by so much."""
    assert graph.translation is not None
    translation = graph.translation.clone()
    edge = int(torch.nonzero(graph.is_odometry & (graph.target == step))[0])
    translation[edge] += torch.tensor(shift, dtype=torch.float64)
    return replace(graph, translation=translation)


# In the first building the second jump takes the first one back, and in the first hills they are ten steps apart:
# neither pays by itself.
@pytest.mark.parametrize(
    ("world", "seed"),
    [
        ("building", 5),
        *(pytest.param(*case, marks=pytest.mark.large) for case in (("building", 8), ("hills", 3), ("hills", 7))),
    ],
)
def test_closures_across_a_jump_are_right(world: str, seed: int) -> None:
    case = case_of(f"{world}: {pose_cases.JUMPS}", seed)
    solution = solve(case.graph)
    is_flagged = solution.outlier_score.numpy() > 0.5
    is_closure, is_wrong = case.is_closure.numpy(), ~case.is_inlier.numpy()
    assert (is_flagged == is_wrong)[is_closure].mean() > 0.98
    turned, placed = errors_of(case, solution)
    assert turned < 1.5 and placed < 0.3
    (warning,) = warned_of_jumps(solution)
    assert "2 times" in warning
    np.testing.assert_array_equal(is_flagged[~is_closure], is_wrong[~is_closure])
    rotation = solution.rotation_score
    assert rotation is not None and float(rotation[case.graph.is_odometry].max()) < 0.05


def test_without_jumps_they_are_flagged() -> None:
    case = case_of(f"building: {pose_cases.JUMPS}", 5)
    solution = solve(case.graph, method="neurora~jumps")
    is_good = (case.is_closure & case.is_inlier).numpy()
    assert (solution.outlier_score.numpy() > 0.5)[is_good].mean() > 0.2
    assert not warned_of_jumps(solution)


@pytest.mark.parametrize("condition", ["30 % parallel corridors in runs", "30 % symmetric building", "30 % random"])
@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.large)])
def test_false_closures_that_agree_are_no_jump(condition: str, seed: int) -> None:
    case = case_of(f"building: {condition}", seed)
    solution = solve(case.graph)
    assert not warned_of_jumps(solution)
    assert float(solution.outlier_score[case.graph.is_odometry].max()) < 0.05


@pytest.mark.parametrize("share", [0.3, pytest.param(0.4, marks=pytest.mark.large)])
def test_a_robot_whose_steps_are_short_jumps_nowhere(shared_data: Path, share: float) -> None:
    """27 of the first closures agree on 13 m, at steps of 14 cm; with jumps as far as anything the map was worse."""
    graph = read_graph(shared_data / "slam" / "b25b" / "B25b_0.000.g2o").graph
    nodes = round(share * graph.num_nodes)
    begun = up_to(graph, nodes)
    solution = solve(begun)
    assert solution.position is not None and not warned_of_jumps(solution)
    assert not (solution.outlier_score > 0.5)[begun.is_odometry].any()


@pytest.mark.parametrize("share", [0.3, pytest.param(1.0, marks=pytest.mark.large)])
@pytest.mark.parametrize("hills", [False, True])
def test_accepted_closures_tell_of_a_jump(hills: bool, share: float) -> None:
    """They cannot join wrong places, so those across the jump are in the tails until it is found."""
    run = simulated(0, num_keyframes=300, **(HILLS if hills else {}))
    graph = jumped(graph_of(run), 151, (5.0, 3.0, 0.0))
    accepted = ~graph.is_odometry & (torch.from_numpy(np.random.default_rng(0).random(graph.num_edges)) < share)
    solution = solve(replace(graph, label=torch.where(accepted, EdgeLabel.ACCEPTED, graph.label)))
    assert len(warned_of_jumps(solution)) == 1
    assert float(solution.outlier_score[~graph.is_odometry].max()) < 0.5
    assert errors(run, solution)[1] < 0.1


def two_robots(run: SimulatedRun, joint: int) -> ViewGraph:
    """The run as two robots', with a jump of the second one's in its middle, and no closures of that one to itself."""
    graph = jumped(graph_of(run), joint + (graph_of(run).num_nodes - joint) // 2 + 1, (5.0, 3.0, 0.0))
    first = torch.minimum(graph.source, graph.target)
    between = graph.is_odometry & (first == joint - 1)
    of_second = ~graph.is_odometry & (first >= joint)
    return graph.select_edges(~between & ~of_second)


# In the plane the first robot rests with what precedes the jump, on the hills with what follows.
@pytest.mark.parametrize(
    ("seed", "hills"),
    [(0, False), (0, True), *(pytest.param(2, hills, marks=pytest.mark.large) for hills in (False, True))],
)
def test_closures_to_another_robot_tell_of_a_jump(seed: int, hills: bool) -> None:
    options = {"num_keyframes": 300, "laps": 2.0, "closures_per_keyframe": 0.25} | (HILLS if hills else {})
    run = simulated(seed, **options)
    graph = two_robots(run, 150)
    solution = solve(graph)
    assert len(warned_of_jumps(solution)) == 1
    assert float(solution.outlier_score[~graph.is_odometry].max()) < 0.5
    assert errors(run, solution)[1] < 0.15


@pytest.mark.parametrize("far", [6.0, pytest.param(60.0, marks=pytest.mark.large)])
def test_a_second_odometry_tells_of_a_jump(far: float) -> None:
    """It holds the map together across the jump: all closures fit, and the first odometry seems to err everywhere."""
    run = simulated(1, num_keyframes=300)
    graph = jumped(graph_of(run), 151, (far, 0.0, 0.0))
    assert graph.translation is not None
    rng, source, position = np.random.default_rng(0), torch.arange(0, 240, 6), torch.from_numpy(run.position)
    body_from_world = rotations.inverse(torch.from_numpy(run.world_from_body))
    turn = rotations.multiply(body_from_world[source + 5], rotations.inverse(body_from_world[source]))
    way = rotations.rotate(body_from_world[source], position[source + 5] - position[source])
    noise = rng.normal(size=(2, len(source), 3))
    turn = rotations.multiply(rotations.exp(torch.from_numpy(0.01 * noise[0] * [0, 0, 1])), turn)
    count = len(source)
    beside = ViewGraph.create(
        torch.cat((graph.source, source)),
        torch.cat((graph.target, source + 5)),
        torch.cat((graph.target_from_source, turn)),
        kind=torch.cat((graph.kind, graph.kind.new_zeros(count))),
        translation=torch.cat((graph.translation, way + torch.from_numpy(0.02 * noise[1] * [1, 1, 0]))),
        steps=torch.cat((graph.steps, graph.steps.new_full((count,), 5))),
    )
    solution = solve(beside)
    assert len(warned_of_jumps(solution)) == 1
    assert errors(run, solution)[1] < 0.05
    memory = solution.memory
    assert isinstance(memory, SlamMemory) and memory.poses is not None
    assert memory.poses.noise.way < 0.001


def test_accepted_odometry_does_not_jump() -> None:
    """Nor the step that is said to be right, where only that one is: its neighbour in the segment is blamed."""
    run = simulated(0, num_keyframes=300)
    graph = jumped(graph_of(run), 151, (5.0, 3.0, 0.0))
    far = int(torch.nonzero(graph.is_odometry & (graph.target == 151))[0])
    for accepted in (graph.is_odometry, torch.arange(graph.num_edges) == far):
        solution = solve(replace(graph, label=torch.where(accepted, EdgeLabel.ACCEPTED, graph.label)))
        assert float(solution.outlier_score[accepted].max()) == 0.0
        memory = solution.memory
        assert isinstance(memory, SlamMemory) and memory.poses is not None
        jump = memory.poses.pose.problem.jump
        assert jump is None or not jump[accepted.numpy()].any()
        if accepted.sum() > 1:
            assert not warned_of_jumps(solution)


@pytest.mark.parametrize("accepted", [False, True])
def test_one_closure_tells_of_a_jump_if_it_is_accepted(accepted: bool) -> None:
    """Else it joins a wrong place as likely."""
    graph = graph_of(simulated(0, num_keyframes=300))
    spans = (torch.minimum(graph.source, graph.target) < 151) & (torch.maximum(graph.source, graph.target) >= 151)
    across = torch.nonzero(spans & ~graph.is_odometry)[:, 0]
    kept = torch.ones(graph.num_edges, dtype=torch.bool)
    kept[across[1:]] = False
    label = graph.label.clone()
    label[across[0]] = EdgeLabel.ACCEPTED if accepted else EdgeLabel.AUTOMATIC
    solution = solve(jumped(replace(graph, label=label), 151, (5.0, 3.0, 0.0)).select_edges(kept))
    assert bool(warned_of_jumps(solution)) == accepted


@pytest.mark.large
def test_a_jump_is_one_however_its_step_is_written() -> None:
    """From the newer end to the older one; and a map ten times as large has it at the same step."""
    case = case_of(f"building: {pose_cases.JUMPS}", 6)
    graph = case.graph
    assert graph.translation is not None
    back = rotations.inverse(graph.target_from_source)
    reversed_step = -rotations.rotate(graph.target_from_source, graph.translation)
    is_odometry = graph.is_odometry
    turned_round = replace(
        graph,
        source=torch.where(is_odometry, graph.target, graph.source),
        target=torch.where(is_odometry, graph.source, graph.target),
        target_from_source=torch.where(is_odometry[:, None], back, graph.target_from_source),
        translation=torch.where(is_odometry[:, None], reversed_step, graph.translation),
    )
    before, after, larger = (
        solve(each) for each in (graph, turned_round, replace(graph, translation=10 * graph.translation))
    )
    flagged = [(each.outlier_score > 0.5)[is_odometry] for each in (before, after, larger)]
    assert flagged[0].any() and flagged[1].eq(flagged[0]).all() and flagged[2].eq(flagged[0]).all()
    assert (before.outlier_score > 0.5).eq(after.outlier_score > 0.5)[~is_odometry].all()
    assert len(warned_of_jumps(after)) == 1
    assert before.position is not None and after.position is not None
    assert float((before.position - after.position).norm(dim=1).max()) < 0.1


@pytest.mark.large
def test_a_jump_is_remembered_while_the_graph_grows() -> None:
    graph = jumped(graph_of(simulated(2, num_keyframes=400, laps=3.0, closures_per_keyframe=0.3)), 120, (7.0, 4.0, 0.0))
    answer = solve(up_to(graph, 300))
    assert len(warned_of_jumps(answer)) == 1
    for nodes in range(302, 331, 4):
        answer = go_on(up_to(graph, nodes), answer)
        assert "refine" not in answer.stage_seconds
    whole = solve(up_to(graph, nodes))
    assert answer.position is not None and whole.position is not None
    assert float((answer.position - whole.position).norm(dim=1).max()) < 0.5
    assert float((answer.outlier_score > 0.5).double().mean()) < 0.02


def test_jumps_are_as_far_as_they_say() -> None:
    case = case_of(f"building: {pose_cases.JUMPS}", 7)
    assert case.graph.translation is not None
    odometry = ~case.is_closure.numpy()
    length = case.graph.translation.norm(dim=1).numpy()[odometry]
    far = ~case.is_inlier.numpy()[odometry]
    assert far.sum() == 2
    typical = np.median(length)
    assert (length[far] > (STEPS[0] - 2) * typical).all() and (length[far] < (STEPS[1] + 2) * typical).all()


@torch.no_grad()
def test_no_step_jumps_farther_than_it_reports() -> None:
    """A hundred closures agree on a jump of five metres at steps of half a metre: they are wrong, all together."""
    run = simulated(3)
    graph = graph_of(run)
    assert graph.translation is not None
    later = torch.maximum(graph.source, graph.target) > graph.num_nodes // 2
    earlier = torch.minimum(graph.source, graph.target) < graph.num_nodes // 2
    across = ~graph.is_odometry & later & earlier
    world = torch.from_numpy(run.world_from_body)[graph.source[across]]
    elsewhere = torch.tensor([5.0, 0.0, 0.0], dtype=torch.float64).expand(int(across.sum()), 3)
    # The newer end, wherever the closure begins.
    sign = torch.where(graph.target > graph.source, 1.0, -1.0)[across, None]
    translation = graph.translation.clone()
    translation[across] += sign * rotations.rotate(rotations.inverse(world), elsewhere)
    solution = solve(replace(graph, translation=translation))
    assert across.sum() > 20
    assert not warned_of_jumps(solution)


@pytest.mark.parametrize("condition", ["jumps", "30 % parallel corridors in runs"])
def test_jumps_that_cannot_gain_are_not_looked_into(condition: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound by which they are left out is one, and the jump is that of largest gain among all."""
    case = case_of(f"building: {pose_cases.JUMPS if condition == 'jumps' else condition}", 5)
    asked: list[Jump | None] = []
    likeliest = jumps.likeliest_jump

    def both(pose: PoseMode, at_least: float) -> Jump | None:
        found = likeliest(pose, at_least)
        witnesses = Witnesses.of(pose, 12.0)
        for end in np.flatnonzero(witnesses.is_wrong)[::7]:
            gain = witnesses.gain_given(int(end))
            assert (gain <= witnesses.most + 1e-6)[witnesses.is_wrong].all()
            assert (gain == witnesses.most)[~witnesses.is_wrong].all()
        of_all = likeliest(pose, -np.inf)
        if found is None:
            assert of_all is None or of_all.gained < at_least
        else:
            assert of_all is not None and of_all.gained == found.gained and of_all.segment == found.segment
        asked.append(found)
        return found

    monkeypatch.setattr(rivals, "likeliest_jump", both)
    solve(case.graph)
    assert any(jump is not None for jump in asked) == (condition == "jumps") and None in asked
