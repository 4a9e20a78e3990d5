"""The estimator's graph on noise-free data: directions, interleavings, who chooses the keyframes, options."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.errors import UserError
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

from .drives import OPTIONS, SECOND, Drive, at, closure, drive, feed, final, make


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


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in (1, 2))])
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


@pytest.mark.parametrize("numbered", [True, False])
def test_a_front_ends_edges_may_come_in_any_order(solver, numbered):
    """A closure by stamp may come before the keyframes of those moments, whether these have ids or stamps alone."""

    def keyframe(number):
        return KeyframeReference("r", number if numbered else None, (number + 1) * SECOND)

    quarter = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]
    pairs = [(keyframe(number), keyframe(number + 1)) for number in range(3)]
    edges = [EdgeMeasurement(row, *pair, quarter, EdgeKind.ODOMETRY) for row, pair in enumerate(pairs)]
    ends = (KeyframeReference("r", stamp_ns=moment * SECOND) for moment in (1, 4))
    edges.append(EdgeMeasurement(3, *ends, [0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5)]))
    for order in permutations(edges):
        estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), solver)
        assert [estimator.add_edge(edge) for edge in order] == [None] * 4
        snapshot = estimator.snapshot()
        stamps = snapshot.stamp_ns[np.stack((snapshot.graph.source, snapshot.graph.target), axis=1)] // SECOND
        assert dict(zip(snapshot.edge_id.tolist(), stamps.tolist(), strict=True)) == {
            0: [1, 2],
            1: [2, 3],
            2: [3, 4],
            3: [1, 4],
        }


def test_a_closure_waits_for_a_keyframe_whose_stamp_comes_later(solver):
    """Odometry that is sent again with the stamps that it lacked tells when its keyframes were."""
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), solver)
    step = EdgeMeasurement(
        0, KeyframeReference("r", 5), KeyframeReference("r", 6), [0.0, 0.0, 0.0, 1.0], EdgeKind.ODOMETRY
    )
    estimator.add_edge(step)
    ends = (KeyframeReference("r", stamp_ns=moment * SECOND) for moment in (1, 2))
    estimator.add_edge(EdgeMeasurement(1, *ends, [0.0, 0.0, 0.0, 1.0]))
    assert estimator.counts().pending == 1
    source, target = (replace(end, stamp_ns=moment * SECOND) for end, moment in ((step.source, 1), (step.target, 2)))
    estimator.add_edge(replace(step, source=source, target=target))
    assert estimator.counts().pending == 0 and estimator.counts().edges == 2


def test_unknown_keyframes_may_be_created(solver):
    estimator = make(solver, EstimatorOptions(unknown_keyframes="create"))
    for edge_id, (source, target) in enumerate([(5, 7), (7, 2**64 - 1)]):
        ends = KeyframeReference("", source), KeyframeReference("", target)
        assert estimator.add_edge(EdgeMeasurement(edge_id, *ends, (0, 0, 0, 1))) is None
    answer = final(estimator)
    assert answer.keyframe_id.tolist() == [5, 7, 2**64 - 1]
    assert answer.stamp_ns.tolist() == [-1] * 3


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


@pytest.mark.parametrize("max_keyframes", [1000, 8])
def test_odometry_numbers_its_keyframes_past_those_of_a_front_end(solver, tmp_path, max_keyframes):
    """A node that is started without ``keyframe_source:=edges`` lays nothing of today on yesterday's keyframes."""
    options = replace(OPTIONS, keyframe_source="edges", max_keyframes=max_keyframes)
    yesterday, run = OnlineEstimator(options, solver), drive()
    for index in range(12):
        step = run.truth[index + 1].inv() * run.truth[index]
        ends = (KeyframeReference("r", number, int(run.stamps[number])) for number in (index, index + 1))
        yesterday.add_edge(EdgeMeasurement(index, *ends, step.as_quat().tolist(), EdgeKind.ODOMETRY))
    yesterday.save(tmp_path / "state.npz")
    today = OnlineEstimator(OPTIONS, solver)
    today.load(tmp_path / "state.npz")
    feed(today, replace(run, stamps=run.stamps + 1000 * SECOND))
    before, after = yesterday.snapshot(), today.snapshot()
    added = after.keyframe_id[len(before.keyframe_id) :]
    assert len(added) == 14 and len(set(after.keyframe_id.tolist())) == len(after.keyframe_id)
    assert not set(added.tolist()) & set(range(13))
    new_edges = slice(len(before.edge_id), None)
    assert int(after.graph.source[new_edges].min()) == len(before.keyframe_id)
    assert len(after.edge_id) == len(before.edge_id) + 13


def test_numpys_numbers_mean_what_pythons_do(solver, tmp_path):
    """In all that a file keeps: edges that wait, labels, stamps and late messages."""

    def grown(whole, real) -> tuple[OnlineEstimator, list[object]]:
        """``whole`` and ``real`` make of numbers what is handed over."""
        online, told = make(solver), []
        for index in range(12):
            pose = real([0.6, 0.0, 0.0, 0.8]), real([0.25 * index, 0.0, 0.0])
            online.add_odometry("r", whole(index * SECOND), *pose)
        for target, stamp_ns in ((3, None), (50, None), (None, 4 * SECOND), (None, 90 * SECOND)):
            by = (None if target is None else whole(target)), (None if stamp_ns is None else whole(stamp_ns))
            ends = KeyframeReference("r", whole(0)), KeyframeReference("r", *by)
            turn, place = real([0.0, 0.0, 0.6, 0.8]), real([0.5, 0.0, 0.0])
            edge = EdgeMeasurement(whole(7), *ends, turn, whole(1), real(3.0), place)
            told.append(online.add_edge(edge))
        again = EdgeMeasurement(7, KeyframeReference("r", 0), KeyframeReference("r", 3), (0.0, 0.0, 0.6, 0.8))
        told.append(online.add_edge(again))
        for stamp_ns in (SECOND, 2 * SECOND):
            told.append(online.add_odometry("r", whole(stamp_ns), *pose))
        told.append(online.label_edge("r", whole(7), EdgeLabel.REJECTED))
        online.tick()
        return online, told

    def content(online: OnlineEstimator) -> dict[str, object]:
        online.save(tmp_path / "state.npz")
        OnlineEstimator(OPTIONS, solver).load(tmp_path / "state.npz")
        with np.load(tmp_path / "state.npz", allow_pickle=False) as archive:
            return {name: archive[name].tobytes() for name in archive.files}

    plain, told = grown(lambda number: number, lambda numbers: numbers)
    numpys, told_too = grown(np.int64, np.float64)
    assert told_too == told and content(numpys) == content(plain)
    assert numpys.counts().pending == 2 and told[4] == "duplicate_edge"


def test_seconds_are_no_stamps() -> None:
    """Taken for nanoseconds, half an hour would pass for two microseconds."""
    online = OnlineEstimator(OPTIONS)
    for stamp in (1_700_000_000.5, np.float64(3.0)):
        with pytest.raises(UserError, match="whole nanoseconds"):
            online.add_odometry("r", stamp, [0.0, 0.0, 0.0, 1.0])  # type: ignore[arg-type]
    assert online.add_odometry("r", 0, [0.0, 0.0, 0.0, 1.0]) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edge_id": 1.0}, "edge_id is 1.0; give a whole number"),
        ({"edge_id": "1"}, "edge_id is '1'; give a whole number"),
        ({"source": KeyframeReference("r", 1.5)}, "keyframe_id is 1.5; give a whole number"),  # type: ignore[arg-type]
        ({"target": KeyframeReference("r", stamp_ns=2.5)}, "stamp_ns is 2.5; give whole nano"),  # type: ignore[arg-type]
    ],
)
def test_an_edge_with_broken_numbers_is_an_error(change: dict, message: str) -> None:
    """A keyframe 1.5 had become a second keyframe 1, and the state's file could not be loaded."""
    online = OnlineEstimator(replace(OPTIONS, unknown_keyframes="create"))
    edge = EdgeMeasurement(1, KeyframeReference("r", 1), KeyframeReference("r", 2), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(UserError, match=message):
        online.add_edge(replace(edge, **change))
    assert online.counts().keyframes == 0
    assert online.add_edge(edge) is None
    with pytest.raises(UserError, match=r"edge_id is 1\.5; give a whole number"):
        online.label_edge("r", 1.5, EdgeLabel.REJECTED)  # type: ignore[arg-type]
