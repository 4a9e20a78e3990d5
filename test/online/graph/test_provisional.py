"""Edges just ahead of odometry that pauses: tied to its end meanwhile, and where they belong once it goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

SECOND = 1_000_000_000
PERIOD_NS = SECOND // 20
# A keyframe every third message; a stamp may be up to two messages ahead.
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, keyframe_interval_s=0.15, stamp_tolerance_s=0.1)
LENGTH = 60


def pose(second: float) -> Rotation:
    """A robot that turns by 60° a second and never drifts."""
    return Rotation.from_rotvec([0, 0, np.radians(60) * second])


def feed(online: OnlineEstimator, start: int, stop: int, robot: str = "r") -> None:
    for step in range(start, stop):
        second = step * PERIOD_NS / SECOND
        assert online.add_odometry(robot, step * PERIOD_NS, pose(second).as_quat(), (second, 0.0, 0.0)) is None


def closure(edge_id: int, source: float, target: float, robots: tuple[str, str] = ("r", "r")) -> EdgeMeasurement:
    """Exact, between two moments, in steps of odometry."""
    ends = (
        KeyframeReference(robot, stamp_ns=round(step * PERIOD_NS))
        for robot, step in zip(robots, (source, target), strict=True)
    )
    first, second = (pose(step * PERIOD_NS / SECOND) for step in (source, target))
    return EdgeMeasurement(edge_id, *ends, (second.inv() * first).as_quat(), translation=(0.5, 0.0, 0.0))


def pause(online: OnlineEstimator, forced: bool = False) -> None:
    for _ in range(1 if forced else 3):
        online.tick(force_cold=forced)
        online.go_on()


def closures(online: OnlineEstimator) -> list[tuple]:
    snapshot = online.snapshot()
    graph, rows = snapshot.graph, np.flatnonzero(snapshot.graph.kind.numpy() == EdgeKind.LOOP_CLOSURE)
    columns = (snapshot.edge_id, graph.source, graph.target, graph.target_from_source, snapshot.translation)
    return sorted(tuple(np.asarray(column[row]).tolist() for column in columns) for row in rows.tolist())


def off_deg(online: OnlineEstimator) -> float:
    """How far the closures in the graph are off at most."""
    graph = online.snapshot()
    rows = graph.graph.kind.numpy() == EdgeKind.LOOP_CLOSURE
    ends = (graph.graph.source.numpy()[rows], graph.graph.target.numpy()[rows])
    source, target = (
        Rotation.concatenate([pose(stamp / SECOND) for stamp in graph.stamp_ns[nodes].tolist()]) for nodes in ends
    )
    measured = Rotation.from_quat(graph.graph.target_from_source.numpy()[rows])
    return float(np.degrees((measured.inv() * (target.inv() * source)).magnitude().max()))


@pytest.mark.parametrize("forced", [False, True])
def test_an_edge_is_tied_to_odometrys_end_only_until_odometry_goes_on(solver, forced: bool) -> None:
    """After two ticks without anything new, or one that somebody asked for."""
    online = OnlineEstimator(OPTIONS, solver)
    feed(online, 0, 30)
    online.tick()
    online.add_edge(closure(1, 4.3, 30.6))
    assert online.counts().pending == 1
    pause(online, forced)
    assert online.counts().pending == 0 and online.counts().edges == 10
    assert off_deg(online) == pytest.approx(60 * 1.6 / 20)
    before = online.snapshot()
    feed(online, 30, 40)
    assert off_deg(online) < 1e-9 and online.counts().edges == 14
    assert before.graph.target[-1] == 9 and closures(online)[0][2] == 10  # a keyframe has come in between
    assert online.add_edge(closure(1, 4.3, 30.6)) == "duplicate_edge"
    answer = online.tick()
    assert answer is not None and answer.outlier.sum() == 0


@given(data=st.data())
@settings(max_examples=40, deadline=None)
def test_whenever_odometry_pauses_the_graph_is_the_same(data) -> None:
    """Also where odometry ends before the last stamps, and pauses again before it has reached one."""
    ahead_at_the_end = st.floats(LENGTH - 1, LENGTH + 1)
    moments = st.tuples(st.floats(1, LENGTH - 2), st.one_of(st.floats(1, LENGTH - 2), ahead_at_the_end))
    edges = [closure(index, *ends) for index, ends in enumerate(data.draw(st.lists(moments, min_size=1, max_size=8)))]
    pauses = data.draw(st.sets(st.integers(5, LENGTH - 1)))

    def grown(*, with_pauses: bool) -> tuple:
        online = OnlineEstimator(OPTIONS, lambda *_, **__: None)
        for edge in edges:
            online.add_edge(edge)
        for step in range(LENGTH):
            feed(online, step, step + 1)
            if with_pauses and step in pauses:
                online._content.builder.settle()
        online._content.builder.settle()
        return closures(online), online.counts().rejected, online.counts().pending

    assert grown(with_pauses=True) == grown(with_pauses=False)


def test_ends_of_two_robots_are_placed_one_after_the_other(solver) -> None:
    online = OnlineEstimator(OPTIONS, solver)
    for robot in ("a", "b"):
        feed(online, 0, 30, robot)
    online.add_edge(closure(1, 30.6, 30.4, ("a", "b")))
    pause(online)
    assert online.counts().pending == 0
    feed(online, 30, 40, "b")
    pause(online)
    assert off_deg(online) == pytest.approx(60 * 1.6 / 20)
    feed(online, 30, 40, "a")
    assert off_deg(online) < 1e-9


def test_an_edge_within_the_last_keyframes_step_waits_until_its_ends_are_two_keyframes(solver) -> None:
    online = OnlineEstimator(OPTIONS, solver)
    feed(online, 0, 30)
    online.add_edge(closure(1, 28.3, 30.6))
    pause(online)
    assert online.counts().pending == 1 and online.counts().rejected == {}
    feed(online, 30, 40)
    assert online.counts().pending == 0 and off_deg(online) < 1e-9


def test_a_state_that_is_saved_in_a_pause_goes_on_from_it(solver, tmp_path: Path) -> None:
    online, again = (OnlineEstimator(OPTIONS, solver) for _ in range(2))
    feed(online, 0, 30)
    online.add_edge(closure(1, 4.3, 30.6))
    pause(online)
    online.save(tmp_path / "state.npz")
    again.load(tmp_path / "state.npz")
    for each in (online, again):
        feed(each, 30, 40)
        assert off_deg(each) < 1e-9 and each.tick() is not None
    assert closures(online) == closures(again)


def test_a_compaction_takes_it_along(solver) -> None:
    online = OnlineEstimator(replace(OPTIONS, max_keyframes=30), solver)
    feed(online, 0, 80)
    online.add_edge(closure(1, 4.3, 80.6))
    pause(online)
    assert online.counts().edges == 27 and online.counts().marginalized == 0
    online.label_edge("r", 1, EdgeLabel.ACCEPTED)
    online.set_options(replace(OPTIONS, max_keyframes=27))
    feed(online, 80, 90)
    assert online.counts().marginalized > 0 and off_deg(online) < 1e-9
    assert (online.snapshot().graph.label == EdgeLabel.ACCEPTED).tolist().count(True) == 1


def test_it_stays_where_it_is_once_the_clock_went_back(solver) -> None:
    """Odometry that comes to its stamp on the new time line tells nothing of it."""
    online = OnlineEstimator(OPTIONS, solver)
    feed(online, 0, 30)
    online.add_edge(closure(1, 4.3, 30.6))
    pause(online)
    before = closures(online)
    for step in range(35):
        online.add_odometry("r", step * PERIOD_NS, pose(100 - step).as_quat(), (0.0, 0.0, 0.0))
    assert online.time_jumps == 1 and closures(online) == before


@pytest.mark.parametrize("forced", [False, True])
def test_the_labels_of_other_edges_are_still_known(forced: bool) -> None:
    """With the real solver: no search begins because one edge is tied to another keyframe."""
    online = OnlineEstimator(OPTIONS)
    for edge_id in range(40):
        edge = closure(edge_id, 10 + 0.5 * edge_id, 60 + 4 * edge_id)
        wrong = Rotation.from_rotvec([0, 0, edge_id % 4 == 0]) * Rotation.from_quat(edge.target_from_source)
        online.add_edge(replace(edge, target_from_source=wrong.as_quat(), translation=None))
    feed(online, 0, 230)
    online.tick()
    online.add_edge(replace(closure(100, 14.3, 230.6), translation=None))
    pause(online, forced)
    feed(online, 230, 240)
    answer = online.tick()
    assert answer is not None and set(answer.stage_seconds) == {"update"}
    assert sorted(answer.edge_id[answer.outlier].tolist()) == list(range(0, 40, 4))
    feed(online, 240, 245)
    later = online.tick()
    assert later is not None and set(later.stage_seconds) == {"update"}
