"""The estimator on noise-free data: directions, interleavings, refusals, gauge, ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.estimator import TickAbandonedError
from rotavg_ros.solver.running.work import stop_if_abandoned
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

SECOND = 1_000_000_000
# Keyframes every third message, so that most stamps lie between keyframes.
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, keyframe_interval_s=0.3)


@dataclass(frozen=True)
class Drive:
    """A robot's true orientations at 10 Hz, and its odometry, which drifts: world_from_body, scipy."""

    stamps: np.ndarray
    truth: Rotation
    odometry: Rotation


def drive(length: int = 40, drift_deg: float = 0.0, seed: int = 0) -> Drive:
    random = np.random.default_rng(seed)
    truth, odometry = [Rotation.random(random_state=seed)], [Rotation.random(random_state=seed + 1)]
    for _ in range(length - 1):
        step = Rotation.from_rotvec(random.normal(0, 0.2, 3))
        truth.append(truth[-1] * step)
        odometry.append(odometry[-1] * step * Rotation.from_rotvec(np.radians([0, 0, drift_deg])))
    stamps = 1_700_000_000 * SECOND + np.arange(length) * SECOND // 10
    return Drive(stamps, Rotation.concatenate(truth), Rotation.concatenate(odometry))


def at(stamp: int, robot: str = "r") -> KeyframeReference:
    return KeyframeReference(robot, stamp_ns=int(stamp))


def closure(run: Drive, edge_id: int, source: int, target: int, robot: str = "r") -> EdgeMeasurement:
    """The true relative rotation of two moments, target_from_source = R_target R_source⁻¹ with R body_from_world."""
    rotation = run.truth[target].inv() * run.truth[source]
    return EdgeMeasurement(edge_id, at(run.stamps[source], robot), at(run.stamps[target], robot), rotation.as_quat())


def feed(estimator: OnlineEstimator, run: Drive, robot: str = "r", start: int = 0, stop: int | None = None) -> None:
    for stamp, rotation in list(zip(run.stamps.tolist(), run.odometry.as_quat().tolist(), strict=True))[start:stop]:
        assert estimator.add_odometry(robot, stamp, rotation) is None


def make(solver, options: EstimatorOptions = OPTIONS) -> OnlineEstimator:
    return OnlineEstimator(options, solver)


def final(estimator: OnlineEstimator) -> Answer:
    """The answer once the input is silent."""
    answer, worked = None, 1.0
    while (newer := estimator.tick()) is not None or worked:
        answer, worked = newer or answer, estimator.go_on()
    assert answer is not None and answer.was_cold
    return answer


def test_keyframes_and_their_edges_follow_odometry(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    answer = final(estimator)
    assert answer.keyframe_id.tolist() == list(range(14))
    np.testing.assert_array_equal(answer.stamp_ns, run.stamps[::3])
    np.testing.assert_allclose(answer.world_from_body, run.odometry[::3].as_quat(canonical=True), atol=1e-12)
    assert answer.kind.tolist() == [EdgeKind.ODOMETRY] * 13
    assert set(answer.edge_id.tolist()) == {2**64 - 1}


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_closure_between_any_two_stamps_closes_the_loop_in_truth(data):
    """Direction: the edge that is stored between keyframes equals what truth has between those very keyframes."""
    run = drive(seed=data.draw(st.integers(0, 5)))
    source, target = data.draw(st.lists(st.integers(0, 39), min_size=2, max_size=2, unique_by=lambda i: i // 3))
    estimator = OnlineEstimator(OPTIONS, lambda *_, **__: None)
    feed(estimator, run)
    assert estimator.add_edge(closure(run, 5, source, target)) is None
    graph = estimator.snapshot().graph
    assert (int(graph.source[-1]), int(graph.target[-1])) == (source // 3, target // 3)
    truth = run.truth[::3]
    expected = truth[target // 3].inv() * truth[source // 3]
    stored = Rotation.from_quat(graph.target_from_source[-1].numpy())
    assert np.degrees((expected.inv() * stored).magnitude()) < 1e-9


def test_a_stamp_between_messages_is_interpolated(solver):
    """A body turning evenly: the closure is measured at moments that no message has."""
    stamps = np.arange(30) * SECOND // 10
    turned = Rotation.from_rotvec(np.outer(0.7 * stamps / SECOND, [0.6, 0, 0.8]))
    run, estimator = Drive(stamps, turned, turned), make(solver)
    feed(estimator, run)
    moments = np.array([0.437, 2.519])
    source, target = Rotation.from_rotvec(np.outer(0.7 * moments, [0.6, 0, 0.8]))
    ends = [at(round(moment * SECOND)) for moment in moments]
    estimator.add_edge(EdgeMeasurement(1, *ends, (target.inv() * source).as_quat()))
    graph = estimator.snapshot().graph
    expected = turned[24].inv() * turned[3]
    np.testing.assert_allclose(graph.target_from_source[-1], expected.as_quat(canonical=True), atol=1e-9)


@given(order=st.permutations(list(range(12))), seed=st.integers(0, 3))
@settings(max_examples=60, deadline=None)
def test_any_interleaving_leads_to_the_same_graph(order, seed):
    run = drive(drift_deg=0.5, seed=seed)
    random = np.random.default_rng(seed)
    pairs = random.choice(40, (12, 2))
    edges = [closure(run, index, *pair) for index, pair in enumerate(pairs.tolist())]
    when = sorted(random.integers(0, 41, 12).tolist())

    def grow(arrivals: list[tuple[int, EdgeMeasurement]]):
        estimator = OnlineEstimator(OPTIONS, lambda *_, **__: None)
        for step in range(41):
            for moment, edge in arrivals:
                if moment == step:
                    estimator.add_edge(edge)
            feed(estimator, run, start=step, stop=step + 1)
        snapshot = estimator.snapshot()
        graph = snapshot.graph
        rows = zip(snapshot.edge_id.tolist(), graph.source.tolist(), graph.target.tolist(), strict=True)
        return (
            sorted((*row, *q) for row, q in zip(rows, graph.target_from_source.tolist(), strict=True)),
            estimator.counts().rejected,
        )

    at_the_end = grow([(40, edge) for edge in edges])
    mixed = grow([(moment, edges[index]) for moment, index in zip(when, order, strict=True)])
    assert mixed == at_the_end


@pytest.mark.parametrize("seed", range(3))
def test_any_interleaving_leads_to_the_same_answer(seed):
    """With the real solver: ticks on the way, warm ones included, leave no trace in the last answer."""
    run = drive(120, drift_deg=0.5, seed=seed)
    random = np.random.default_rng(seed)
    edges = [closure(run, index, *random.choice(120, 2, replace=False).tolist()) for index in range(20)]
    when = random.integers(1, 120, 20)
    at_the_end = OnlineEstimator(OPTIONS)
    feed(at_the_end, run)
    for edge in edges:
        at_the_end.add_edge(edge)
    mixed = OnlineEstimator(OPTIONS)
    for step in range(120):
        feed(mixed, run, start=step, stop=step + 1)
        for index in np.flatnonzero(when == step):
            mixed.add_edge(edges[index])
        if step % 20 == 19:
            mixed.tick()
            mixed.go_on()
    one, other = final(at_the_end), final(mixed)
    between = Rotation.from_quat(one.world_from_body).inv() * Rotation.from_quat(other.world_from_body)
    assert np.degrees(between.magnitude().max()) < 1e-6
    flags = [dict(zip(a.edge_id.tolist(), a.outlier.tolist(), strict=True)) for a in (one, other)]
    assert flags[0] == flags[1]


def test_closures_by_id_wait_for_their_keyframe(solver):
    run, estimator = drive(), make(solver)
    rotation = run.truth[30].inv() * run.truth[0]
    edge = EdgeMeasurement(1, KeyframeReference("r", 0), KeyframeReference("r", 10), rotation.as_quat())
    estimator.add_edge(edge)
    feed(estimator, run, stop=30)
    assert estimator.counts().pending == 1
    feed(estimator, run, start=30)
    assert estimator.counts().pending == 0
    assert estimator.counts().edges == 14


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"target_from_source": (0, 0, math.nan, 1)}, "nan_rotation"),
        ({"target_from_source": (0, 0, 0, math.inf)}, "nan_rotation"),
        ({"target_from_source": (0, 0, 0, 0)}, "zero_quaternion"),
        ({"target_from_source": (0, 0, 1, 1)}, "unnormalized_quaternion"),
        ({"kind": 2}, "bad_kind"),
        ({"precision": -1.0}, "bad_precision"),
        ({"precision": math.nan}, "bad_precision"),
        ({"precision": math.inf}, "bad_precision"),
        ({"edge_id": -1}, "id_out_of_range"),
        ({"edge_id": 2**64}, "id_out_of_range"),
        ({"source": KeyframeReference("r", 2**64)}, "id_out_of_range"),
        ({"source": KeyframeReference("r")}, "bad_reference"),
        ({"source": at(-5)}, "bad_stamp"),
        ({"source": KeyframeReference("r", 3), "target": KeyframeReference("r", 3)}, "self_edge"),
        ({"source": at(1_700_000_001 * SECOND), "target": at(1_700_000_001 * SECOND + 1)}, "self_edge"),
        ({"source": at(1_600_000_000 * SECOND)}, "stamp_out_of_range"),
    ],
)
def test_a_bad_edge_is_counted_and_changes_nothing(solver, change, reason):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    estimator.add_edge(closure(run, 1, 0, 30))
    final(estimator)
    assert estimator.add_edge(replace(closure(run, 2, 3, 33), **change)) == reason
    assert estimator.counts().rejected == {reason: 1}
    assert estimator.tick() is None


def test_options_that_change_during_a_solve_are_in_the_next_answer(solver):
    """Once there is nothing else to solve for."""
    changes = [replace(OPTIONS, outlier_threshold=0.9)]

    def changing(*arguments: Any, **options: Any) -> Any:
        if changes:
            estimator.set_options(changes.pop())
        return solver(*arguments, **options)

    run, estimator = drive(), make(changing)
    feed(estimator, run)
    assert estimator.tick(force_cold=True) is not None
    assert estimator.tick() is not None and estimator.tick() is None


def test_edges_that_wait_in_vain_are_counted(solver):
    run = drive()
    estimator = make(solver, replace(OPTIONS, pending_capacity=2, pending_timeout_s=1.0))
    for edge_id in range(3):
        estimator.add_edge(
            EdgeMeasurement(edge_id, KeyframeReference("r", 0), KeyframeReference("r", 99), (0, 0, 0, 1))
        )
    assert estimator.counts().rejected == {"pending_overflow": 1}
    feed(estimator, run)
    assert estimator.counts().rejected == {"pending_overflow": 1, "pending_timeout": 2}
    assert estimator.counts().pending == 0


def test_a_stamp_just_ahead_of_the_odometry_is_settled_when_the_input_is_silent(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    ahead = replace(closure(run, 1, 0, 39), target=at(run.stamps[39] + SECOND // 20))
    too_far = replace(closure(run, 2, 0, 39), target=at(run.stamps[39] + SECOND // 5))
    estimator.add_edge(ahead)
    estimator.add_edge(too_far)
    assert estimator.counts().pending == 2
    assert final(estimator).edge_id.tolist()[-1] == 1
    assert estimator.counts().pending == 1


def test_retransmissions_are_dropped_and_repeated_measurements_kept(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    edge = closure(run, 1, 0, 30)
    again = replace(
        edge,
        target_from_source=(Rotation.from_quat(edge.target_from_source) * Rotation.from_rotvec([0, 0, 1e-6])).as_quat(),
    )
    reasons = [estimator.add_edge(e) for e in (edge, edge, again, replace(edge, edge_id=2))]
    assert reasons == [None, "duplicate_edge", None, None]
    waiting = replace(edge, target=KeyframeReference("r", 77))
    assert [estimator.add_edge(waiting), estimator.add_edge(waiting)] == [None, "duplicate_edge"]


def test_the_front_end_chooses_the_keyframes(solver):
    """Ids and stamps come with odometry edges; closures wait for them; odometry leads on to the present."""
    run = drive()
    estimator = make(solver, replace(OPTIONS, keyframe_source="edges"))
    rotation = run.truth[30].inv() * run.truth[0]
    estimator.add_edge(EdgeMeasurement(0, KeyframeReference("r", 100), KeyframeReference("r", 130), rotation.as_quat()))
    for index in range(10, 40, 10):
        step = run.odometry[index].inv() * run.odometry[index - 10]
        ends = [KeyframeReference("r", 100 + i, int(run.stamps[i])) for i in (index - 10, index)]
        estimator.add_edge(EdgeMeasurement(index, *ends, step.as_quat(), EdgeKind.ODOMETRY))
    feed(estimator, run)
    answer = final(estimator)
    assert answer.keyframe_id.tolist() == [100, 110, 120, 130]
    assert answer.edge_id.tolist() == [10, 20, 0, 30]
    np.testing.assert_allclose(answer.world_from_body[0], run.odometry[0].as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(estimator.current_orientation("r"), run.odometry[39].as_quat(canonical=True), atol=1e-12)


def test_unknown_keyframes_may_be_created(solver):
    estimator = make(solver, EstimatorOptions(unknown_keyframes="create"))
    for edge_id, (source, target) in enumerate([(5, 7), (7, 2**64 - 1)]):
        ends = KeyframeReference("", source), KeyframeReference("", target)
        assert estimator.add_edge(EdgeMeasurement(edge_id, *ends, (0, 0, 0, 1))) is None
    answer = final(estimator)
    assert answer.keyframe_id.tolist() == [5, 7, 2**64 - 1]
    assert answer.stamp_ns.tolist() == [-1] * 3


def test_warm_while_data_flows_then_cold_once_then_nothing(solver):
    run, estimator = drive(), make(solver)
    assert estimator.tick() is None
    feed(estimator, run, stop=10)
    assert estimator.tick().was_cold  # nothing to start from
    assert estimator.tick() is None
    feed(estimator, run, start=10, stop=20)
    assert not estimator.tick().was_cold
    assert estimator.tick().was_cold
    assert estimator.tick() is None and estimator.tick(force_cold=True) is None
    assert (solver.calls, solver.warm) == (3, 1)
    feed(estimator, run, start=20, stop=21)  # no new keyframe: nothing to solve
    assert estimator.tick() is None
    feed(estimator, run, start=21)
    assert estimator.tick(force_cold=True).was_cold
    assert estimator.tick() is None


def test_a_failing_solver_is_tried_again(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    solver.on_call = lambda: (_ for _ in ()).throw(RuntimeError("no"))
    with pytest.raises(RuntimeError):
        estimator.tick()
    solver.on_call = None
    assert final(estimator).version == 1


def test_input_during_a_solve_belongs_to_the_next(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run, stop=20)
    solver.on_call = lambda: feed(estimator, run, start=20) if solver.calls == 1 else None
    assert len(estimator.tick().keyframe_id) == 7
    assert len(final(estimator).keyframe_id) == 14


def test_reset_during_a_solve_throws_its_answer_away(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    solver.on_call = estimator.reset
    with pytest.raises(TickAbandonedError, match="forgotten or replaced"):
        estimator.tick()
    assert estimator.counts().keyframes == 0 and estimator.counts().rejected == {}
    assert estimator.tick() is None


@pytest.mark.parametrize("act", ["reset", "load", "pause"])
def test_a_solve_is_given_up_where_nobody_waits_for_its_answer(solver, tmp_path, act: str) -> None:
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    before = estimator.tick()
    estimator.save(tmp_path / "state.npz")
    feed(estimator, drive(seed=2), robot="s")
    acts = {
        "reset": estimator.reset,
        "load": lambda: estimator.load(tmp_path / "state.npz"),
        "pause": lambda: estimator.pause(True),
    }
    asked = []

    def solve_until_told() -> None:
        stop_if_abandoned()
        acts[act]()
        asked.append(act)
        stop_if_abandoned()
        pytest.fail("the solve went on")

    solver.on_call = solve_until_told
    with pytest.raises(TickAbandonedError, match="paused" if act == "pause" else "forgotten or replaced"):
        estimator.tick()
    solver.on_call = None
    assert asked == [act]
    if act == "pause":
        assert estimator.tick() is None
        estimator.pause(False)
    answer = estimator.tick()
    assert len(before.keyframe_id) == 14
    assert (0 if answer is None else len(answer.keyframe_id)) == {"reset": 0, "load": 14, "pause": 28}[act]


def test_a_pause_leaves_an_answer_alone_that_somebody_has_asked_for(solver) -> None:
    estimator = make(solver)
    feed(estimator, drive())

    def pause() -> None:
        estimator.pause(True)
        stop_if_abandoned()

    solver.on_call = pause
    assert estimator.tick(force_cold=True) is not None


def test_an_empty_graph_is_nothing_to_solve() -> None:
    estimator = OnlineEstimator(OPTIONS)

    def nothing() -> None:
        assert estimator.tick() is None and estimator.tick(force_cold=True) is None and not estimator.is_behind

    nothing()
    estimator.set_options(replace(OPTIONS, outlier_threshold=0.4))
    nothing()
    feed(estimator, drive())
    assert estimator.tick() is not None
    estimator.reset()
    estimator.set_options(OPTIONS)
    nothing()


def test_pause_keeps_inputs_and_stops_ticks(solver):
    run, estimator = drive(), make(solver)
    estimator.pause(True)
    feed(estimator, run)
    assert estimator.tick() is None and solver.calls == 0
    assert estimator.tick(force_cold=True) is not None
    estimator.pause(False)
    estimator.add_edge(closure(run, 1, 0, 30))
    assert len(final(estimator).edge_id) == 14


def test_current_orientation_is_the_last_corrected_keyframe_then_odometry(solver):
    run, estimator = drive(), make(solver)
    assert estimator.current_orientation("r") is None and estimator.world_from_odometry("r") is None
    feed(estimator, run, stop=2)
    np.testing.assert_allclose(estimator.current_orientation("r"), run.odometry[1].as_quat(canonical=True), atol=1e-12)
    feed(estimator, run, start=2, stop=20)
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3])
    estimator._solver = lambda graph, **kwargs: turned_after_the_first(solver(graph, **kwargs), turn)
    np.testing.assert_allclose(
        final(estimator).world_from_body[1:], (turn * run.odometry[3:20:3]).as_quat(canonical=True), atol=1e-12
    )
    feed(estimator, run, start=20)
    expected = turn * run.odometry[39]
    np.testing.assert_allclose(estimator.current_orientation("r"), expected.as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(estimator.world_from_odometry("r"), turn.as_quat(canonical=True), atol=1e-12)


def turned_after_the_first(solution: Any, turn: Rotation) -> Any:
    """The solution with every world_from_body but the first turned in the first one's world."""
    body_from_world = Rotation.from_quat(solution.body_from_world.numpy())
    world_from_first = drive().odometry[0]  # the gauge that the estimator will give to the solver's identity
    turned = body_from_world * world_from_first.inv() * turn.inv() * world_from_first
    kept_first = torch.from_numpy(np.vstack(([0, 0, 0, 1.0], turned[1:].as_quat())))
    return replace(solution, body_from_world=kept_first)


@pytest.mark.parametrize("gauge", ["odometry", "identity"])
def test_the_first_keyframe_never_moves_and_orientation_fits_from_the_start(solver, gauge):
    run, estimator = drive(drift_deg=1), make(solver, replace(OPTIONS, gauge=gauge))
    feed(estimator, run, stop=1)
    first = run.odometry[0].as_quat(canonical=True) if gauge == "odometry" else np.array([0, 0, 0, 1.0])
    np.testing.assert_allclose(estimator.current_orientation("r"), first, atol=1e-12)
    for step in range(1, 40, 5):
        feed(estimator, run, start=step, stop=step + 5)
        if step > 20:
            estimator.add_edge(closure(run, step, 0, step))
        np.testing.assert_allclose(estimator.tick().world_from_body[0], first, atol=1e-12)


def test_when_components_join_the_older_keeps_its_gauge_and_a_rejected_edge_leaves_both_where_they_are(solver):
    one, two = drive(seed=1), drive(seed=2)
    estimator = make(solver)
    feed(estimator, one, "one")
    feed(estimator, two, "two")
    apart = final(estimator)
    assert apart.num_components == 2 and apart.robots == ("one", "two")
    np.testing.assert_allclose(apart.world_from_body[14], two.odometry[0].as_quat(canonical=True), atol=1e-12)
    bridge = Rotation.from_rotvec([0.3, -0.2, 0.1])
    edge = EdgeMeasurement(8, KeyframeReference("two", 3), KeyframeReference("one", 5), bridge.as_quat())
    estimator.add_edge(edge)
    joined = estimator.tick()
    assert joined.was_cold and joined.num_components == 1  # the old answer is no start
    np.testing.assert_allclose(joined.world_from_body[:14], apart.world_from_body[:14], atol=1e-12)
    expected = Rotation.from_quat(joined.world_from_body[5]) * bridge  # world_from_one ∘ one_from_two
    np.testing.assert_allclose(joined.world_from_body[17], expected.as_quat(canonical=True), atol=1e-12)
    assert estimator.label_edge("one", 8, EdgeLabel.REJECTED) == 0
    assert estimator.label_edge("two", 8, EdgeLabel.REJECTED) == 1
    split = final(estimator)
    assert split.num_components == 2
    assert split.outlier.tolist() == [False] * 26 + [True]
    np.testing.assert_allclose(split.world_from_body, joined.world_from_body, atol=1e-12)


def test_a_label_holds_for_waiting_edges_and_later_ones(solver):
    run, estimator = drive(), make(solver)
    late = EdgeMeasurement(4, KeyframeReference("r", 0), KeyframeReference("r", 13), (0, 0, 0, 1))
    estimator.add_edge(late)
    assert estimator.label_edge("r", 4, EdgeLabel.REJECTED) == 1
    assert estimator.label_edge("r", 5, EdgeLabel.REJECTED) == 0
    feed(estimator, run)
    estimator.add_edge(replace(late, target_from_source=(0, 0, 0.6, 0.8)))
    assert final(estimator).outlier.tolist() == [False] * 13 + [True, True]
    assert estimator.label_edge("r", 4, EdgeLabel.AUTOMATIC) == 2
    assert not final(estimator).outlier.any()


def test_wrong_options_are_refused():
    from rotavg_ros.errors import UserError

    for change in (
        {"gauge": "up"},
        {"keyframe_source": "moon"},
        {"unknown_keyframes": "drop"},
        {"stamp_tolerance_s": -1},
        {"pending_timeout_s": math.nan},
        {"pending_capacity": 0},
        {"outlier_threshold": 1.5},
    ):
        with pytest.raises(UserError, match=next(iter(change))):
            EstimatorOptions(**change)
