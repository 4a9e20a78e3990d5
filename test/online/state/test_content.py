"""A save and a load in the middle of anything change nothing of what becomes of the graph."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.content import ContentState
from rotavg_ros.online.state import content as state_content
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

SECOND = 1_000_000_000
START = 1_000 * SECOND
ROBOTS = ("a", "b")
OPTIONS = EstimatorOptions(
    keyframe_angle=0,
    keyframe_distance=0,
    keyframe_interval_s=0.25,
    max_keyframes=40,
    max_edges=70,
    max_odometry_samples=60,
    pending_capacity=12,
    pending_timeout_s=4.0,
    device="cpu",
)
Event = Callable[[OnlineEstimator], object]


class Robots:
    """Two robots far from where their odometry began, and whatever may come from them and about them."""

    def __init__(self) -> None:
        self.now = dict.fromkeys(ROBOTS, START)
        self.steps = dict.fromkeys(ROBOTS, 0)

    def odometry(self, robot: str, milliseconds: int, jump_deg: float, late_ms: int) -> Event:
        """A step, after a jump of the pose, or a message that is late and moves nothing."""
        stamp_ns = self.now[robot] - late_ms * SECOND // 1000
        if late_ms == 0:
            self.now[robot] += milliseconds * SECOND // 1000
            self.steps[robot] += 1
            stamp_ns = self.now[robot]
        step = self.steps[robot]
        turn = Rotation.from_euler("zx", [90 + jump_deg + 2 * step, 30], degrees=True).as_quat().tolist()
        return lambda online: online.add_odometry(robot, stamp_ns, turn, (20 + 0.1 * step, 5.0, 1.0))

    def clock_set_back(self, robot: str, seconds: int) -> None:
        self.now[robot] -= seconds * SECOND

    def edge(self, edge_id: int, ends: list[tuple[str, int, bool]], kind: EdgeKind) -> Event:
        """By keyframe, or by a stamp up to a second ahead of what has come so far."""
        source, target = (
            KeyframeReference(robot, stamp_ns=max(0, self.now[robot] + (10 - back) * SECOND // 10))
            if by_stamp
            else KeyframeReference(robot, back)
            for robot, back, by_stamp in ends
        )
        turn = Rotation.from_rotvec([0.01 * edge_id, 0, 0.3]).as_quat().tolist()
        edge = EdgeMeasurement(edge_id, source, target, turn, kind, 3.0, (0.1, float(edge_id), 0.0))
        return lambda online: online.add_edge(edge)


robots = st.sampled_from(ROBOTS)
ends = st.lists(st.tuples(robots, st.integers(0, 40), st.booleans()), min_size=2, max_size=2)
steps = st.one_of(
    st.tuples(st.just("odometry"), robots, st.integers(30, 900), st.sampled_from([0.0] * 12 + [80.0]), st.just(0)),
    st.tuples(st.just("odometry"), robots, st.integers(30, 900), st.just(0.0), st.just(0)),
    st.tuples(st.just("odometry"), robots, st.just(0), st.just(0.0), st.sampled_from([1, 500, 2_500, 20_000])),
    st.tuples(st.just("ahead"), robots, st.sampled_from([70, 4_000])),
    st.tuples(st.just("set back"), robots, st.sampled_from([2, 30, 900])),
    st.tuples(st.just("edge"), st.integers(0, 40), ends, st.just(EdgeKind.LOOP_CLOSURE)),
    st.tuples(st.just("label"), robots, st.integers(0, 40), st.sampled_from(list(EdgeLabel))),
    st.tuples(st.just("clock"), st.integers(0, 40)),
    st.tuples(st.just("tick"), st.booleans()),
)


def events(drawn: list[tuple], policy: str) -> tuple[list[Event], set[int]]:
    """What is drawn, as calls, and before which of them a robot is silent for more than a minute.

    A clock that was set back is followed by enough odometry to show it.
    """
    both, made, breaks = Robots(), [], set()
    heard = dict.fromkeys(ROBOTS, 0)  # after which call the robot was last heard for sure
    newest = dict.fromkeys(ROBOTS, START)  # odometry that is behind this is refused where a jump is ignored
    for name, *values in drawn:
        if name == "odometry":
            made.append(both.odometry(*values))
            robot, _, jump_deg, late_ms = values
            is_behind = policy == "ignore" and both.now[robot] <= newest[robot]
            if jump_deg == 0 and late_ms == 0 and not is_behind:
                heard[robot], newest[robot] = len(made), both.now[robot]
        elif name == "ahead":
            robot, seconds = values
            both.now[robot] += seconds * SECOND
            breaks |= set(range(heard[robot], len(made) + 1))
            if policy != "ignore" or both.now[robot] > newest[robot]:
                heard[robot], newest[robot] = len(made) + 3, both.now[robot] + 300 * SECOND // 1000
            made += [both.odometry(robot, 100, 0.0, 0) for _ in range(3)]
        elif name == "set back":
            both.clock_set_back(*values)
            made += [both.odometry(values[0], 100, 0.0, 0) for _ in range(6)]
        elif name == "edge":
            made.append(both.edge(*values))
        elif name == "label":
            made.append(lambda online, values=values: online.label_edge(*values))
        elif name == "clock":
            made.append(lambda online, back=values[0]: online.clock_went_back(START - back * SECOND // 10))
        else:
            made.append(lambda online, cold=values[0]: online.tick(force_cold=cold))
    return made, breaks


class Judge:
    """Flags every third edge, so that compactions have something to go by."""

    def __init__(self, solver) -> None:
        self._solver = solver

    def __call__(self, graph, **options):
        solution = self._solver(graph, **options)
        solution.outlier_score[::3] = 1.0
        return solution


def content(online: OnlineEstimator, path: Path) -> dict[str, object]:
    """Everything that a state file holds, but for the number of answers there have been."""
    online.save(path)
    with np.load(path, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files if name != "header"}
        header = json.loads(archive["header"].tobytes())
    del header["version"]
    turns = header.pop("world_from_odometry")
    arrays |= {f"world_from_odometry of {robot}": np.array(turn, dtype=float) for robot, turn in turns.items()}
    return arrays | header


def compare(first: dict[str, object], second: dict[str, object], tolerance: float = 0.0) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        if isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating):
            np.testing.assert_allclose(second[name], value, rtol=0, atol=tolerance, err_msg=name)
        else:
            np.testing.assert_equal(second[name], value, err_msg=name)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    drawn=st.lists(steps, min_size=1, max_size=80),
    cuts=st.lists(st.floats(0, 1), min_size=1, max_size=3),
    policy=st.sampled_from(["new_component", "new_component", "ignore"]),
)
def test_a_cut_anywhere_changes_nothing(solver, tmp_path, drawn, cuts, policy) -> None:
    """Odometry stays far from where it began, so that it is seen to go on; breaks are no longer than a minute."""
    options = replace(OPTIONS, on_time_jump=policy)
    whole, parts = (OnlineEstimator(options, Judge(solver)) for _ in range(2))
    calls, breaks = events(drawn, policy)
    at = {round(cut * len(calls)) for cut in cuts} - breaks
    for index, call in enumerate(calls):
        if index in at:
            saved = content(parts, tmp_path / "state.npz")
            parts = OnlineEstimator(options, Judge(solver))
            parts.load(tmp_path / "state.npz")
            compare(saved, content(parts, tmp_path / "again.npz"))
            # The node ticks then, to have something to publish; a tick may settle what waits at odometry's end.
            whole.tick(), parts.tick()
        call(whole), call(parts)
    # What was solved from another start may differ by rounding.
    compare(content(whole, tmp_path / "whole.npz"), content(parts, tmp_path / "parts.npz"), tolerance=1e-12)


def test_options_that_change_while_a_file_is_read_count(solver, tmp_path, monkeypatch) -> None:
    online, restore = OnlineEstimator(OPTIONS, solver), state_content.restore
    online.add_odometry("a", START, (0.0, 0.0, 0.0, 1.0))
    online.save(tmp_path / "state.npz")

    def restore_slowly(*arguments: Any) -> ContentState:
        restored = restore(*arguments)
        online.set_options(replace(OPTIONS, keyframe_interval_s=1.0))
        return restored

    monkeypatch.setattr(state_content, "restore", restore_slowly)
    online.load(tmp_path / "state.npz")
    for tenths in range(1, 21):
        online.add_odometry("a", START + tenths * SECOND // 10, (0.0, 0.0, 0.0, 1.0))
    assert online.counts().keyframes == 3, "one a second"


def test_what_the_streams_above_reach(solver, tmp_path) -> None:
    """They would prove little if they never filled the graph, thinned odometry or set a clock back."""
    online = OnlineEstimator(OPTIONS, Judge(solver))
    drawn = [("odometry", robot, 200, 0.0, 0) for _ in range(60) for robot in ROBOTS]
    drawn += [("edge", index, [("a", index, False), ("b", 5, True)], EdgeKind.LOOP_CLOSURE) for index in range(40)]
    drawn += [("tick", False), ("set back", "a", 30), ("odometry", "a", 100, 80.0, 0), ("odometry", "b", 0, 0.0, 2_500)]
    for call in events(drawn, "new_component")[0]:
        call(online)
    counts, state = online.counts(), content(online, tmp_path / "state.npz")
    assert counts.marginalized > 0 and counts.time_jumps == 1 and counts.pending > 0
    assert len(state["odometry0_stamp_ns"]) < 60 and len(state["odometry0_refused_stamp_ns"]) == 1
    assert state["backward_jumps"]["runs"]["b"] and state["outlier"].any()


@pytest.mark.parametrize("restart", [False, True])
def test_closures_that_join_two_robots_are_not_judged_by_how_these_lay(solver, tmp_path: Path, restart: bool) -> None:
    """After a load the robots had counted as joined: all closures between them were flagged, and none was solved."""
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), solver)
    ends = {robot: [KeyframeReference(robot, number) for number in range(100)] for robot in "ab"}
    for robot in "ab":
        for number, (before, after) in enumerate(itertools.pairwise(ends[robot])):
            online.add_edge(EdgeMeasurement(number, before, after, (0.0, 0.0, 0.6, 0.8), EdgeKind.ODOMETRY))
    online.tick()
    if restart:
        online.save(tmp_path / "state.npz")
        online = OnlineEstimator(online.options, solver)
        online.load(tmp_path / "state.npz")
    step, between = Rotation.from_quat([0.0, 0.0, 0.6, 0.8]), Rotation.from_rotvec([2, 0, 0])
    for number, (one, other) in enumerate(itertools.product(range(20), range(20))):
        seen = step**other * between * step**-one
        online.add_edge(EdgeMeasurement(number, ends["a"][one], ends["b"][other], seen.as_quat()))
    answer = online.tick()
    assert answer is not None and answer.waits.any()
    assert answer.num_components == 1 and not answer.outlier.any()
