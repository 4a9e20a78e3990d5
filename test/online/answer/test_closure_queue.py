"""Floods of closures: what enters a solve when, and that ordinary numbers of them change nothing."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.answer import screening
from rotavg_ros.online.answer.closure_queue import EntryLimits
from rotavg_ros.solver.slam.update.grown_edges import begins_with
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

from ..conftest import TreeSolution, TreeSolver

LIMITS = EntryLimits()
KEYFRAMES, STEP_DEG = 200, 3.0
OPTIONS = EstimatorOptions(keyframe_source="edges", gauge="identity")
FLOOD = 10_000  # ids of false closures begin here


class Recording(TreeSolver):
    """Keeps the graphs that it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.graphs: list[ViewGraph] = []

    def __call__(self, graph: ViewGraph, **options: Any) -> TreeSolution:
        self.graphs.append(graph)
        return super().__call__(graph, **options)


def edge(edge_id: int, source: int, target: int, turn_deg: float, kind: EdgeKind) -> EdgeMeasurement:
    """Of a robot that turns by 3° with every keyframe."""
    target_from_source = Rotation.from_euler("z", -turn_deg, degrees=True).as_quat()
    ends = KeyframeReference("r", source), KeyframeReference("r", target)
    return EdgeMeasurement(edge_id, *ends, target_from_source, kind)


class Run:
    """A robot that drives on, and closures that come as they are asked for."""

    def __init__(self, options: EstimatorOptions = OPTIONS) -> None:
        self.solver, self.keyframes, self.closures = Recording(), 0, 0
        self.online = OnlineEstimator(options, self.solver)
        self.rng = np.random.default_rng(0)

    def drive(self, keyframes: int) -> None:
        for _ in range(keyframes):
            self.online.add_edge(edge(0, self.keyframes, self.keyframes + 1, STEP_DEG, EdgeKind.ODOMETRY))
            self.keyframes += 1

    def close(self, count: int, *, false: bool = False) -> None:
        for _ in range(count):
            source, target = sorted(self.rng.choice(self.keyframes, 2, replace=False).tolist())
            turn = STEP_DEG * (target - source) + (self.rng.uniform(90, 270) if false else self.rng.normal())
            self.closures += 1
            self.online.add_edge(
                edge(self.closures + (FLOOD if false else 0), source, target, turn, EdgeKind.LOOP_CLOSURE)
            )

    def tick(self) -> Answer:
        answer = self.online.tick()
        assert answer is not None
        return answer


def closures(graph: ViewGraph) -> int:
    return int((~graph.is_odometry).sum())


def same(a: ViewGraph, b: ViewGraph) -> bool:
    names = ("source", "target", "target_from_source", "kind", "label", "steps")
    return a.num_nodes == b.num_nodes and all(torch.equal(getattr(a, name), getattr(b, name)) for name in names)


@given(counts=st.lists(st.tuples(st.integers(1, 5), st.integers(0, LIMITS.at_least)), min_size=2, max_size=6))
@settings(max_examples=20, deadline=None)
def test_in_ordinary_numbers_what_is_solved_is_the_graph_itself(counts: list[tuple[int, int]]) -> None:
    """So every answer is what it was before closures could wait, bit for bit."""
    run = Run()
    run.drive(50)
    for keyframes, count in counts:
        run.drive(keyframes)
        run.close(count, false=True)
        answer = run.tick()
        assert run.solver.graphs[-1] is not None and same(run.solver.graphs[-1], run.online.snapshot().graph)
        assert not answer.waits.any() and run.online.counts().queued == 0


def test_a_graph_that_is_loaded_at_once_enters_at_once() -> None:
    run = Run()
    run.drive(20)
    run.tick()
    run.drive(300)
    run.close(1200)
    assert not run.tick().waits.any()


def test_what_was_solved_before_a_restart_does_not_wait_after_it(tmp_path: Path) -> None:
    run = Run()
    run.drive(300)
    run.close(1200)
    run.tick()
    run.online.save(tmp_path / "state")
    run.online = OnlineEstimator(OPTIONS, run.solver)
    run.online.load(tmp_path / "state")
    run.drive(1)
    run.close(3)
    assert not run.tick().waits.any()
    assert same(run.solver.graphs[-1], run.online.snapshot().graph)


def test_without_odometry_a_graph_grows_by_closures() -> None:
    online = OnlineEstimator(EstimatorOptions(unknown_keyframes="create"), TreeSolver())
    online.add_edge(edge(0, 0, 1, STEP_DEG, EdgeKind.LOOP_CLOSURE))
    online.tick()
    for number in range(1, 1001):
        online.add_edge(edge(number, number % 7, 7 + number % 5, STEP_DEG, EdgeKind.LOOP_CLOSURE))
    answer = online.tick()
    assert answer is not None and not answer.waits.any()


@pytest.fixture
def flooded() -> Run:
    """A good graph with an answer, and then 3000 false closures among 300 good ones."""
    run = Run()
    run.drive(KEYFRAMES)
    run.close(200)
    run.tick()
    run.drive(1)
    for _ in range(30):
        run.close(100, false=True)
        run.close(10)
    return run


def test_a_flood_enters_in_batches_good_ones_first(flooded: Run) -> None:
    run, before = flooded, 200
    for tick in range(8):
        answer = run.tick()
        most = LIMITS.at_least + LIMITS.share * before + LIMITS.per_keyframe
        now = closures(run.solver.graphs[-1])
        assert before <= now <= before + most
        assert int(answer.waits.sum()) == run.online.counts().queued == 3300 + 200 - now
        good = answer.edge_id < FLOOD
        if tick >= 3:  # 300 good ones have entered by then, however late they came, but for some that err by most
            assert (answer.waits & good).sum() < 0.03 * good.sum()
        assert answer.waits[~good].all()  # of so many false ones none is tried
        before = now
        run.drive(1)


def test_what_waits_has_a_score_from_its_residual_and_pulls_nothing(flooded: Run) -> None:
    answer = flooded.tick()
    is_false = answer.edge_id > FLOOD
    assert (answer.outlier_score[answer.waits & is_false] > 0.99).all()
    assert (answer.outlier_score[answer.waits & ~is_false] < 0.5).mean() > 0.95
    assert closures(flooded.solver.graphs[-1]) + int(answer.waits.sum()) == 3500
    turned = Rotation.from_quat(answer.world_from_body).as_rotvec()[:, 2] - np.radians(STEP_DEG) * np.arange(202)
    assert np.degrees(np.abs((turned + np.pi) % (2 * np.pi) - np.pi)).max() < 1e-6


def test_a_solve_begins_with_the_edges_of_the_one_before(flooded: Run) -> None:
    """The solver goes on from its memory of the last solve only if it does."""
    for _ in range(6):
        flooded.tick()
        flooded.close(3)
        flooded.drive(2)
    graphs = flooded.solver.graphs
    assert all(begins_with(later, earlier) for earlier, later in itertools.pairwise(graphs))


def test_idle_ends_with_all_of_them_in(flooded: Run) -> None:
    answers = []
    while (answer := flooded.online.tick()) is not None:
        answers.append(answer)
    assert len(answers) < 10  # each tick takes in twice as many
    assert answers[-1].was_cold and not any(answer.was_cold for answer in answers[:-1])
    assert not answers[-1].waits.any() and flooded.online.counts().queued == 0
    assert same(flooded.solver.graphs[-1], flooded.online.snapshot().graph)


def test_who_asks_for_the_whole_answer_gets_it(flooded: Run) -> None:
    answer = flooded.online.tick(force_cold=True)
    assert answer is not None and not answer.waits.any()
    assert same(flooded.solver.graphs[-1], flooded.online.snapshot().graph)


def test_a_closure_that_a_user_has_judged_does_not_wait(flooded: Run) -> None:
    answer = flooded.tick()
    waiting = int(answer.edge_id[answer.waits][-1])
    flooded.online.label_edge("r", waiting, EdgeLabel.ACCEPTED)
    answer = flooded.tick()
    assert not answer.waits[answer.edge_id == waiting].any() and answer.waits.any()


def test_contradiction_enters_only_at_the_newest_keyframes_while_much_is_flagged() -> None:
    """A solver that flags all false ones: they stay few among those solved, for each makes a tick dearer."""

    def flagging(graph: ViewGraph, **options: Any) -> TreeSolution:
        solution = TreeSolver()(graph, **options)
        turned = Rotation.from_quat(graph.target_from_source.numpy()).as_rotvec()[:, 2]
        expected = -np.radians(STEP_DEG) * (graph.target - graph.source).numpy()
        off = np.abs((turned - expected + np.pi) % (2 * np.pi) - np.pi)
        solution.outlier_score[:] = torch.from_numpy(np.clip(off, 0, 1))
        return solution

    run = Run()
    run.online = OnlineEstimator(OPTIONS, flagging)
    run.drive(KEYFRAMES)
    run.close(200)
    run.tick()
    run.close(2000, false=True)
    for _ in range(20):
        run.drive(1)
        answer = run.tick()
    is_old = np.maximum(answer.source, answer.target) < KEYFRAMES - LIMITS.newest
    flagged_in = int((answer.outlier & ~answer.waits & is_old).sum())
    assert flagged_in <= LIMITS.at_least + LIMITS.contradicting * (LIMITS.at_least + 20)
    run.online.add_edge(edge(FLOOD + 9999, 3, run.keyframes - 5, 100.0, EdgeKind.LOOP_CLOSURE))
    run.drive(1)
    answer = run.tick()
    assert not answer.waits[answer.edge_id == FLOOD + 9999].any()


@pytest.mark.parametrize("change", ["save", "compact"])
def test_they_wait_on(flooded: Run, tmp_path: Path, change: str) -> None:
    """After a load, and after a compaction, it is the same ones that wait."""
    online = flooded.online
    waiting = {*(answer := flooded.tick()).edge_id[answer.waits].tolist()}
    if change == "save":
        online.save(tmp_path / "state")
        online.load(tmp_path / "state")
    else:
        online.set_options(EstimatorOptions(keyframe_source="edges", gauge="identity", max_edges=3000))
    flooded.drive(1)
    flooded.close(1)
    answer = flooded.tick()
    assert {*answer.edge_id[answer.waits].tolist()} <= {*waiting, flooded.closures}
    assert closures(flooded.solver.graphs[-1]) == int((answer.kind == EdgeKind.LOOP_CLOSURE).sum() - answer.waits.sum())
    assert answer.waits.any() and (online.counts().dropped_closures > 0) == (change == "compact")


@pytest.mark.parametrize("under_way", [False, True])
def test_a_full_graph_does_not_take_those_that_wait_for_false(under_way: bool) -> None:
    """After a slip of odometry the good closures contradict the answer, and wait. Every keyframe keeps one of them.

    So it is while the solve is under way that they have entered, and has not answered yet.
    """
    run = Run()
    run.drive(KEYFRAMES)
    run.close(200)
    run.drive(100)
    run.tick()
    for number in range(400):
        source, target = KEYFRAMES + number // 5, int(run.rng.integers(KEYFRAMES))
        run.online.add_edge(edge(FLOOD + number, source, target, STEP_DEG * (target - source) + 90, 1))
    answer = run.tick()
    assert answer.waits.sum() > 250 and answer.outlier[answer.waits].all()
    waiting = {*answer.edge_id[answer.waits].tolist()}

    def ends_of_waiting() -> set[int]:
        left = run.online.snapshot()
        ends = np.maximum(left.graph.source.numpy(), left.graph.target.numpy())
        return {*left.keyframe_id[ends[np.isin(left.edge_id, [*waiting])]].tolist()}

    def compact() -> None:
        run.online.set_options(replace(OPTIONS, max_edges=750))
        run.drive(1)
        assert run.online.counts().dropped_closures > 200

    before = ends_of_waiting()
    if under_way:
        run.solver.on_call = compact
        run.online.tick(force_cold=True)
    else:
        compact()
    assert ends_of_waiting() == before


def test_of_a_flood_of_random_closures_none_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the answer is so unsure that it explains a tenth of them; what the robot finds meanwhile is."""
    monkeypatch.setattr(screening, "_DEVIATION", np.radians(10))
    monkeypatch.setattr(screening, "_LEAST_DEVIATION", np.radians(10))
    run = Run()
    run.drive(KEYFRAMES)
    run.close(200)
    run.tick()
    run.drive(1)
    for _ in range(4000):
        source, target = sorted(run.rng.choice(KEYFRAMES - LIMITS.newest, 2, replace=False).tolist())
        run.online.add_edge(edge(FLOOD, source, target, run.rng.uniform(-180, 180), EdgeKind.LOOP_CLOSURE))
    for _ in range(5):
        run.drive(2)
        for source in run.rng.choice(KEYFRAMES, 3).tolist():
            turn = STEP_DEG * (run.keyframes - source) + run.rng.normal()
            run.online.add_edge(edge(1, source, run.keyframes, turn, EdgeKind.LOOP_CLOSURE))
        answer = run.tick()
        is_false, is_closure = answer.edge_id == FLOOD, answer.kind == EdgeKind.LOOP_CLOSURE
        assert answer.waits[is_false].all() and answer.outlier[is_false].all()
        assert not answer.waits[is_closure & ~is_false].any() and not answer.outlier[is_closure & ~is_false].any()
        assert answer.residual_deg[is_false].min() < 1
        assert run.online.counts().by_chance > 100


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 3))])
def test_what_enters_does_not_depend_on_the_order_in_which_a_flood_comes(seed: int) -> None:
    entered = []
    for order in (np.arange(1200), np.random.default_rng(seed).permutation(1200)):
        run = Run()
        run.drive(KEYFRAMES)
        run.close(200)
        run.tick()
        run.drive(1)
        rng = np.random.default_rng(seed)
        ends = np.sort([rng.choice(KEYFRAMES, 2, replace=False) for _ in range(1200)], axis=1)
        turns = np.where(np.arange(1200) < 200, STEP_DEG * (ends[:, 1] - ends[:, 0]), 0)
        turns = turns + np.where(np.arange(1200) < 200, rng.normal(size=1200), rng.uniform(-180, 180, 1200))
        for i in order.tolist():
            run.online.add_edge(edge(FLOOD + i, *ends[i].tolist(), turns[i], EdgeKind.LOOP_CLOSURE))
        answer = run.tick()
        entered.append(np.sort(answer.edge_id[~answer.waits & (answer.edge_id >= FLOOD)]))
    np.testing.assert_array_equal(*entered)
