"""What may go on to a back end: believed closures, each once, in order; and what becomes of them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros.online import EdgeMeasurement, KeyframeReference
from rotavg_ros.online.answer import closure_filter
from rotavg_ros.online.answer.closure_filter import ClosureFilter
from rotavg_ros.view_graph import EdgeKind

from ..drives import OPTIONS, closure, drive, feed, make


def answer(verdicts: list[tuple[str, int, bool]], odometry: int = 3) -> SimpleNamespace:
    """An answer whose first edges are odometry; closures by robot, id and whether they are held false."""
    robots = ("a", "b")
    named = [("a", 2**64 - 1, False)] * odometry + verdicts
    return SimpleNamespace(
        robots=robots,
        keyframe_robot=np.array([0, 1], dtype=np.int32),
        source=np.array([robots.index(robot) for robot, _, _ in named], dtype=np.int64),
        edge_id=np.array([edge_id for _, edge_id, _ in named], dtype=np.uint64),
        kind=np.array([EdgeKind.ODOMETRY] * odometry + [EdgeKind.LOOP_CLOSURE] * len(verdicts)),
        outlier=np.array([is_false for _, _, is_false in named]),
        waits=np.zeros(len(named), dtype=bool),
    )


def test_what_is_believed_passes_once_and_in_order():
    closures: ClosureFilter[str] = ClosureFilter()
    for edge_id in (7, 3, 5, 9):
        closures.take(("a", edge_id), f"a{edge_id}", now=0.0)
    closures.take(("b", 3), "b3", now=0.0)
    verdicts = [("a", 3, False), ("a", 5, True), ("a", 7, False), ("b", 3, False)]  # 9 has not been placed yet
    assert closures.decide(answer(verdicts), now=1.0, delay_s=0.0).passed == ["a7", "a3", "b3"]
    assert closures.decide(answer(verdicts), now=2.0, delay_s=0.0).passed == []
    assert len(closures) == 2
    verdicts += [("a", 9, False)]
    verdicts[1] = ("a", 5, False)
    assert closures.decide(answer(verdicts), now=3.0, delay_s=0.0).passed == ["a5", "a9"]
    assert len(closures) == 0


def test_a_name_that_stands_for_several_closures_is_told_of_if_one_of_them_is_to_go_on():
    """The others may have come from a sender whose closures nobody sends on."""
    closures: ClosureFilter[str] = ClosureFilter()
    closures.take(("a", 1), "it", now=0.0)
    alone = [("a", 1, False), ("a", 2, False), ("a", 2, False), ("b", 1, False)]
    assert not closures.decide(answer(alone), now=1.0, delay_s=0.0).shares_names
    assert closures.decide(answer([*alone, ("a", 1, True)]), now=2.0, delay_s=0.0).shares_names


def test_a_closure_that_is_not_solved_yet_does_not_pass_however_well_it_fits():
    closures: ClosureFilter[str] = ClosureFilter()
    closures.take(("a", 1), "it", now=0.0)
    queued = answer([("a", 1, False)])
    queued.waits[-1] = True
    assert closures.decide(queued, now=1.0, delay_s=0.0).passed == []
    queued.waits[-1] = False
    assert closures.decide(queued, now=2.0, delay_s=0.0).passed == ["it"]


def test_a_closure_waits_until_it_is_old_enough():
    closures: ClosureFilter[str] = ClosureFilter()
    closures.take(("a", 1), "first", now=0.0)
    closures.take(("a", 2), "second", now=4.0)
    believed = answer([("a", 1, False), ("a", 2, False)])
    assert [closures.decide(believed, now, delay_s=5.0).passed for now in (4.9, 5.0, 8.9, 9.0)] == [
        [],
        ["first"],
        [],
        ["second"],
    ]


def test_who_turns_out_false_is_revoked_and_may_be_reinstated():
    closures: ClosureFilter[str] = ClosureFilter()
    for edge_id in (1, 2):
        closures.take(("a", edge_id), str(edge_id), now=0.0)
    good, bad = (answer([("a", 1, False), ("a", 2, is_false), ("b", 2, True)]) for is_false in (False, True))
    assert closures.decide(good, 0.0, 0.0).passed == ["1", "2"]
    for _ in range(2):
        revoked = closures.decide(bad, 0.0, 0.0)
        assert (revoked.passed, revoked.revoked.tolist(), revoked.reinstated.tolist()) == ([], [4], [])
        assert closures.decide(bad, 0.0, 0.0).revoked.tolist() == []
        assert not closures.passes(("a", 2)) and closures.passes(("a", 1))
        reinstated = closures.decide(good, 0.0, 0.0)
        assert (reinstated.revoked.tolist(), reinstated.reinstated.tolist()) == ([], [4])
    # What the graph has dropped is not revoked.
    assert closures.decide(answer([("a", 1, False)]), 0.0, 0.0).revoked.tolist() == []
    assert closures.decide(answer([], odometry=0), 0.0, 0.0).revoked.tolist() == []


def test_what_the_estimator_no_longer_has_does_not_wait(solver):
    """An edge may wait for a keyframe that does not come, and is then refused."""
    run, estimator = drive(), make(solver, replace(OPTIONS, pending_timeout_s=2.0))
    closures: ClosureFilter[str] = ClosureFilter()
    waiting = EdgeMeasurement(2, KeyframeReference("r", 0), KeyframeReference("r", 99), (0, 0, 0, 1))
    feed(estimator, run, stop=10)
    for edge in (closure(run, 1, 0, 9), waiting):
        assert estimator.add_edge(edge) is None
        closures.take(("r", edge.edge_id), "", now=0.0)
    for stop, left in ((25, [1, 2]), (40, [1])):
        feed(estimator, run, start=stop - 15, stop=stop)
        closures.forget_all_but(estimator.closure_keys())
        assert [edge_id for edge_id in (1, 2) if closures.knows(("r", edge_id))] == left and len(closures) == len(left)


def test_measurements_of_one_name_go_together():
    closures: ClosureFilter[str] = ClosureFilter()
    closures.take(("a", 1), "good", now=0.0)
    closures.take(("a", 1), "false", now=0.0)
    assert closures.decide(answer([("a", 1, False), ("a", 1, True)]), 0.0, 0.0).passed == []
    assert closures.decide(answer([("a", 1, False), ("a", 1, False)]), 0.0, 0.0).passed == ["good", "false"]


def test_a_full_waiting_room_drops_the_oldest_for_new_names_alone(monkeypatch):
    monkeypatch.setattr(closure_filter, "_MOST_WAITING", 3)
    closures: ClosureFilter[str] = ClosureFilter()
    for edge_id in (1, 2, 3, 2):
        closures.take(("a", edge_id), str(edge_id), now=0.0)
    assert len(closures) == 3 and closures.knows(("a", 1)) and closures.dropped == 0
    closures.take(("a", 4), "4", now=0.0)
    assert len(closures) == 3 and not closures.knows(("a", 1)) and closures.dropped == 1


def test_of_graphs_the_newest_measurement_of_a_closure_counts():
    closures: ClosureFilter[None] = ClosureFilter(newest_counts=True)
    assert closures.decide(answer([]), 0.0, 0.0).passed == []
    closures.take(("a", 1), None, now=0.0)
    closures.decide(answer([("a", 1, True)]), 0.0, 0.0)
    assert not closures.passes(("a", 1))
    closures.take(("a", 1), None, now=1.0)  # refined
    refined = answer([("a", 1, True), ("b", 1, True), ("a", 1, False)])
    closures.decide(refined, 1.0, 0.0)
    assert closures.passes(("a", 1)) and not closures.passes(("b", 1))
    closures.decide(answer([("a", 1, False), ("a", 1, True)]), 2.0, 0.0)
    assert not closures.passes(("a", 1))


@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_at_any_time_passed_but_for_revoked_is_what_was_believed_last(data):
    closures: ClosureFilter[int] = ClosureFilter()
    taken: list[int] = []
    is_false: dict[int, bool] = {}
    believed: set[int] = set()
    handed_out: list[int] = []
    for _ in range(data.draw(st.integers(1, 6))):
        for _ in range(data.draw(st.integers(0, 4))):
            closures.take(("a", len(taken)), len(taken), now=0.0)
            taken.append(len(taken))
        is_false |= {edge_id: data.draw(st.booleans()) for edge_id in taken[: data.draw(st.integers(0, len(taken)))]}
        now = answer([("a", edge_id, false) for edge_id, false in is_false.items()])
        decision = closures.decide(now, 0.0, 0.0)
        handed_out += decision.passed
        believed |= {*decision.passed, *now.edge_id[decision.reinstated].tolist()}
        believed -= set(now.edge_id[decision.revoked].tolist())
        assert believed == {edge_id for edge_id, false in is_false.items() if not false}
    assert len(set(handed_out)) == len(handed_out)
