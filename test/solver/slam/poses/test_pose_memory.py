"""Poses of a graph that grows: what odometry adds, where the joint solve goes on, and when it begins from nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

from .test_poses import HILLS, displaced, graph_of, held_by_gravity, simulated


def run_of(seed: int = 0) -> SimulatedRun:
    return simulated(seed, num_keyframes=400, laps=3.0, closures_per_keyframe=0.3, false_share=0.2)


def up_to(graph: ViewGraph, num_nodes: int, closures_up_to: int | None = None) -> ViewGraph:
    """The first nodes and their edges in the order in which a robot meets them."""
    latest = torch.maximum(graph.source, graph.target)
    limit = num_nodes if closures_up_to is None else closures_up_to
    chosen = torch.nonzero(latest < torch.where(graph.is_odometry, num_nodes, limit))[:, 0]
    order = torch.argsort(2 * latest[chosen] + (~graph.is_odometry[chosen]), stable=True)
    return replace(graph.select_edges(chosen[order]), num_nodes=num_nodes)


def go_on(graph: ViewGraph, before: Solution, method: str = "neurora") -> Solution:
    """The next answer of a graph that has grown; new nodes start where they may."""
    more = graph.num_nodes - len(before.body_from_world)
    start = torch.cat((before.body_from_world, rotations.identity(more)))
    return solve(graph, method=method, warm_start=start, memory=before.memory)


def apart(first: Solution, second: Solution) -> tuple[float, float]:
    """Largest difference of orientations, degrees, and of positions, metres."""
    assert first.position is not None and second.position is not None
    turned = rotations.angle_between(first.body_from_world, second.body_from_world)
    return float(torch.rad2deg(turned.max())), float((first.position - second.position).norm(dim=1).max())


def with_second_odometry(run: SimulatedRun, source: int, target: int) -> ViewGraph:
    """The run's graph with one more edge of odometry, beside the chain, that does not err."""
    graph = graph_of(run)
    assert graph.translation is not None
    body_from_world = rotations.inverse(torch.from_numpy(run.world_from_body))
    turn = rotations.multiply(body_from_world[target], rotations.inverse(body_from_world[source]))
    way = torch.from_numpy(run.position[target] - run.position[source])
    return ViewGraph.create(
        torch.cat((torch.tensor([source]), graph.source)),
        torch.cat((torch.tensor([target]), graph.target)),
        torch.cat((turn[None], graph.target_from_source)),
        kind=torch.cat((torch.tensor([EdgeKind.ODOMETRY]), graph.kind)),
        translation=torch.cat((rotations.rotate(body_from_world[source], way)[None], graph.translation)),
    )


def test_odometry_alone_is_laid_on_as_a_whole_solve_has_it() -> None:
    graph = graph_of(run_of())
    before = solve(up_to(graph, 300))
    grown = up_to(graph, 330, closures_up_to=300)
    found, whole = go_on(grown, before), solve(grown)
    assert "refine" not in found.stage_seconds
    turned, moved = apart(found, whole)
    assert turned < 0.05 and moved < 0.05
    assert (found.outlier_score[: before.outlier_score.numel()] == before.outlier_score).all()
    assert found.position_uncertainty is not None and whole.position_uncertainty is not None
    ratio = (found.position_uncertainty / whole.position_uncertainty)[310:]
    assert float(ratio.min()) > 0.55 and float(ratio.max()) < 1.6


@pytest.mark.parametrize(("method", "most"), [("neurora~turns", 1.3), ("neurora", 2.2)])
def test_odometry_that_is_laid_on_counts_as_in_a_whole_solve(method: str, most: float) -> None:
    """But that a whole solve tells steps that turn from others, which have half the variance of a usual one here."""
    graph = graph_of(run_of())
    before = solve(up_to(graph, 300), method=method)
    grown = up_to(graph, 330, closures_up_to=300)
    found, whole = go_on(grown, before, method), solve(grown, method=method)
    assert found.edge_precision is not None and whole.edge_precision is not None
    added = slice(before.outlier_score.numel(), None)
    laid_on, told = ((1 / solution.edge_precision[added]).sum(dim=0) for solution in (found, whole))
    assert 0.75 < float(laid_on[0] / told[0]) < most
    torch.testing.assert_close(laid_on[1], told[1], rtol=0.3, atol=0)


def held_run() -> ViewGraph:
    """On hills, by odometry whose roll and pitch gravity holds."""
    return held_by_gravity(simulated(2, **HILLS, closures_per_keyframe=0.3, false_share=0.2), 0.3)


@pytest.mark.parametrize(
    "made",
    [lambda: displaced(run_of(1), 0.3, 1)[0], pytest.param(held_run, marks=pytest.mark.large)],
    ids=["plane", "gravity"],
)
def test_updates_say_what_a_whole_solve_says(made: Callable[[], ViewGraph]) -> None:
    """And no closure's flag goes to and fro between an update, which judges by both, and a whole solve."""
    graph = made()
    answer = solve(up_to(graph, 250))
    flips, last, updates = 0, answer.outlier_score > 0.5, 0
    for nodes in range(252, 301, 3):
        answer = go_on(up_to(graph, nodes), answer)
        updates += "update" in answer.stage_seconds and "refine" not in answer.stage_seconds
        flags = answer.outlier_score > 0.5
        flips += int((flags[: len(last)] != last).sum())
        last = flags
    whole = solve(up_to(graph, nodes))
    assert updates > 5
    assert answer.position is not None and answer.rotation_score is not None
    assert flips < 10
    # Within what either knows: noise is estimated to a tenth, and ends where the other began.
    turned = rotations.angle_between(answer.body_from_world, whole.body_from_world)
    assert float(turned.median()) < 0.3 * float(whole.uncertainty.median())
    assert float(turned.max()) < 1.5 * float(whole.uncertainty.median())
    assert apart(answer, whole)[1] < 0.1
    assert ((answer.outlier_score > 0.5) != (whole.outlier_score > 0.5)).sum() <= 1


@pytest.mark.parametrize("kept", [False, True], ids=["memory", "labels"])
def test_the_first_closure_comes_after_places(kept: bool) -> None:
    """Odometry and another odometry's edge beside it give places, before there are any closures."""
    run = simulated(0)
    graph = with_second_odometry(run, 10, 14)
    without = graph.select_edges(graph.is_odometry)
    first = torch.nonzero(~graph.is_odometry)[0, 0].item()
    grown = graph.select_edges(torch.cat((torch.nonzero(graph.is_odometry)[:, 0], torch.tensor([first]))))
    before = solve(without)
    memory = before.memory
    assert isinstance(memory, SlamMemory) and memory.poses is not None and len(memory.poses.edge) == 0
    found = solve(grown, warm_start=before.body_from_world, memory=memory.labels if kept else memory)
    assert "refine" not in found.stage_seconds
    assert float(found.outlier_score[-1]) < 0.5
    whole = solve(grown)
    turned, moved = apart(found, whole)
    assert np.radians(turned) < 0.2 * float(whole.uncertainty.max()) and moved < 0.05


def test_a_label_makes_places_anew() -> None:
    """Memory of other labels is of another graph: the answer is that of a solve without it, given the same start."""
    graph = up_to(graph_of(run_of(2)), 400)
    before = solve(graph)
    closure = int(torch.nonzero(~graph.is_odometry)[3, 0])
    label = graph.label.clone()
    label[closure] = EdgeLabel.REJECTED
    labelled = replace(graph, label=label)
    with_memory, without = (
        solve(labelled, warm_start=before.body_from_world, memory=memory) for memory in (before.memory, None)
    )
    turned, moved = apart(with_memory, without)
    assert turned == 0.0 and moved == 0.0
    assert float(with_memory.outlier_score[closure]) == 1.0


def test_robots_that_meet_are_placed_anew() -> None:
    """A closure between two chains moves one of them into the other's frame."""
    run = run_of(3)
    graph = graph_of(run)
    cut = 200
    crosses = (torch.minimum(graph.source, graph.target) < cut) & (torch.maximum(graph.source, graph.target) >= cut)
    two = graph.select_edges(~crosses)
    bridges = torch.nonzero(crosses & ~graph.is_odometry)[:, 0]
    good = bridges[torch.from_numpy(~run.closure_is_false[bridges.numpy()])]
    joined = torch.cat((torch.nonzero(~crosses)[:, 0], good[:12]))
    before = solve(two)
    assert int(before.component.max()) == 1
    found, whole = (
        solve(graph.select_edges(joined), **more)
        for more in ({"warm_start": before.body_from_world, "memory": before.memory}, {})
    )
    assert int(found.component.max()) == 0
    turned, moved = apart(found, whole)
    assert turned < 0.5 and moved < 0.5


def test_translations_that_come_later_are_used_at_once() -> None:
    graph = graph_of(run_of(4))
    alone = solve(replace(up_to(graph, 300), translation=None))
    assert alone.position is None
    assert go_on(up_to(graph, 305), alone).position is not None


def test_a_biased_gyroscopes_poses_are_gone_on_from(monkeypatch: pytest.MonkeyPatch) -> None:
    """What closures join is not judged from nothing again; the bias that was found stays taken out."""
    graph = graph_of(simulated(0, odometry_bias_deg=1.0, odometry_noise_deg=0.05))
    begun = []

    def recording(problem: PoseProblem, **options: object) -> PoseMode:
        begun.append(options.get("start"))
        return estimate_poses(problem, **options)

    monkeypatch.setattr("rotavg_ros.solver.slam.poses.solve.estimate_poses", recording)
    before = solve(up_to(graph, 390))
    assert isinstance(before.memory, SlamMemory) and before.memory.calibration is not None and not begun
    found = go_on(up_to(graph, 400), before)
    assert len(begun) == 1 and begun[0] is not None and "refine" not in found.stage_seconds
    turned, moved = apart(found, solve(up_to(graph, 400)))
    assert turned < 0.5 and moved < 0.3
