"""Edges that the estimator refuses, drops, or keeps waiting."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, KeyframeReference
from rotavg_ros.view_graph import EdgeKind

from .drives import OPTIONS, SECOND, at, closure, drive, feed, final, make


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
        ({"target_from_source": (0, 0, 1)}, "wrong_length"),
        ({"translation": (1.0, 2.0)}, "wrong_length"),
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


@pytest.mark.parametrize(("rotation", "position"), [((0, 0, 1), None), ((0, 0, 0, 1), (1.0, 2.0)), ((), ())])
def test_odometry_of_wrong_lengths_is_counted_and_changes_nothing(solver, rotation, position):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    final(estimator)
    assert estimator.add_odometry("r", run.stamps[-1] + SECOND, rotation, position) == "wrong_length"
    assert estimator.add_odometry("another", run.stamps[-1] + SECOND, rotation, position) == "wrong_length"
    assert estimator.counts().rejected == {"wrong_length": 2}
    assert estimator.tick() is None


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


@pytest.mark.parametrize("lead_s", [0, 3600])
def test_edges_wait_in_the_time_of_the_robot_that_they_wait_for(solver, lead_s: int) -> None:
    """Whatever the clock of another robot says. Until a robot comes, edges wait for it in the other end's time."""
    run, other = drive(), drive(seed=1)
    estimator = make(solver, replace(OPTIONS, pending_timeout_s=1.5))
    feed(estimator, run, stop=20)
    estimator.add_edge(closure(run, 1, 0, 30))
    between = replace(closure(run, 2, 9, 30), target=at(run.stamps[0] - SECOND, "absent"))
    estimator.add_edge(between)
    feed(estimator, replace(other, stamps=other.stamps + lead_s * SECOND), robot="s", stop=10)
    assert estimator.counts().pending == 2 and estimator.counts().rejected == {}
    feed(estimator, run, start=20)
    assert estimator.counts().pending == 0 and estimator.counts().rejected == {"pending_timeout": 1}
    assert 1 in estimator.snapshot().edge_id.tolist()


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


@pytest.mark.parametrize("turned_deg", [0.0, 3.0, 30.0])
@pytest.mark.parametrize("chosen_by", ["edges", "odometry"])
def test_a_front_end_that_counts_from_zero_again_is_told_by_its_odometry(solver, turned_deg, chosen_by):
    """Elsewhere ids are the node's own, and further odometry between its keyframes may well tell of a slip."""
    run, estimator = drive(), make(solver, replace(OPTIONS, keyframe_source=chosen_by))
    if chosen_by == "odometry":
        feed(estimator, run, stop=7)

    def step(number: int, turn: Rotation, edge_id: int = 0) -> EdgeMeasurement:
        ends = KeyframeReference("r", number), KeyframeReference("r", number + 1)
        return EdgeMeasurement(edge_id, *ends, turn.as_quat(), EdgeKind.ODOMETRY)

    turns = [Rotation.from_rotvec([0.1 * number, 0.2, 0.0]) for number in range(2)]
    assert [estimator.add_edge(step(number, turn)) for number, turn in enumerate(turns)] == [None, None]
    edges = estimator.counts().edges
    again = step(0, turns[0] * Rotation.from_euler("z", turned_deg, degrees=True), edge_id=1)
    is_refused = chosen_by == "edges" and turned_deg > 10
    assert estimator.add_edge(again) == ("contradictory_odometry" if is_refused else None)
    assert estimator.counts().rejected == ({"contradictory_odometry": 1} if is_refused else {})
    assert estimator.counts().edges == edges + (not is_refused)


@pytest.mark.parametrize("turned_deg", [0.5, 30.0])
@pytest.mark.parametrize(
    ("later_ns", "is_refused"),
    [
        ((0, 0), {0.5: False, 30.0: False}),  # another measurement between the same keyframes
        ((9 * SECOND, 9 * SECOND), {0.5: True, 30.0: True}),  # other keyframes of the same ids
        ((0, 9 * SECOND), {0.5: False, 30.0: True}),  # unclear: the rotation decides
        ((None, 9 * SECOND), {0.5: False, 30.0: True}),
    ],
)
def test_stamps_tell_a_second_odometry_from_a_front_end_that_has_begun_anew(solver, turned_deg, later_ns, is_refused):
    """Of two measurements the solver finds the wrong one; before, the one that came first was all it saw. A robot that
    begins anew and drives straight on turns as it did before."""
    estimator = make(solver, replace(OPTIONS, keyframe_source="edges"))
    stamps_ns = 5 * SECOND, 6 * SECOND
    ends = [KeyframeReference("r", number, stamp_ns) for number, stamp_ns in enumerate(stamps_ns)]
    again = [
        KeyframeReference("r", number, None if later is None else stamp_ns + later)
        for number, (stamp_ns, later) in enumerate(zip(stamps_ns, later_ns, strict=True))
    ]
    turned = tuple(Rotation.from_euler("z", turned_deg, degrees=True).as_quat())
    assert estimator.add_edge(EdgeMeasurement(0, *ends, (0, 0, 0, 1), EdgeKind.ODOMETRY)) is None
    said = estimator.add_edge(EdgeMeasurement(1, *again, turned, EdgeKind.ODOMETRY))
    assert said == ("contradictory_odometry" if is_refused[turned_deg] else None)
    assert estimator.counts().edges == 2 - is_refused[turned_deg]
