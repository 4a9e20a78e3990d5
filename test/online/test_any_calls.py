"""Whatever is called in whatever order: in silence the answer is what ``solve`` says of the graph."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from scipy.spatial.transform import Rotation

from rotavg_ros import solve
from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

MILLISECOND = 1_000_000
ROBOTS = ("a", "b")
TOLERANCE_DEG, TOLERANCE_SCORE = 0.05, 0.02

robots = st.sampled_from(ROBOTS)
ids = st.integers(0, 12)
turns = st.sampled_from([(0.0, 0.0, 0.02), (0.01, 0.0, -0.03), (1.0, -2.0, 0.5)])


class Calls(RuleBasedStateMachine):
    """Two robots, whose keyframes odometry or a front end chooses, and everything that a user may call."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()  # one of each example's own; pytest's would be of all together
        self.now = dict.fromkeys(ROBOTS, 1_000_000 * MILLISECOND)
        self.steps = dict.fromkeys(ROBOTS, 0)
        self.sent: list[EdgeMeasurement] = []
        self.version = 0

    @initialize(
        source=st.sampled_from(["odometry", "odometry", "edges"]),
        unknown=st.sampled_from(["wait", "create"]),
        max_keyframes=st.sampled_from([8, 1000]),
        gauge=st.sampled_from(["odometry", "identity"]),
        jump=st.sampled_from(["new_component", "reset", "ignore"]),
    )
    def begin(self, source: str, unknown: str, max_keyframes: int, gauge: str, jump: str) -> None:
        options = EstimatorOptions(
            keyframe_source=source,
            unknown_keyframes=unknown,
            keyframe_angle=0,
            keyframe_distance=0,
            keyframe_interval_s=0.25,
            max_keyframes=max_keyframes,
            max_odometry_samples=50,
            gauge=gauge,
            on_time_jump=jump,
            device="cpu",
        )
        self.online = OnlineEstimator(options)

    @rule(robot=robots, count=st.integers(1, 12), knows_places=st.booleans(), turn=st.booleans())
    def drive(self, robot: str, count: int, knows_places: bool, turn: bool) -> None:
        by_front_end = self.online.options.keyframe_source == "edges"
        for _ in range(count):
            self.now[robot] += 100 * MILLISECOND
            self.steps[robot] += 1
            step = self.steps[robot]
            place = (20 + 0.1 * step, 5.0, 1.0) if knows_places else (math.nan,) * 3
            pose = Rotation.from_euler("zx", [90 + 3 * step * turn, 30], degrees=True).as_quat().tolist()
            self.online.add_odometry(robot, self.now[robot], pose, place)
            if by_front_end:
                ends = KeyframeReference(robot, step - 1), KeyframeReference(robot, step, self.now[robot])
                measured = (0.0, 0.0, -math.sin(0.026), math.cos(0.026))
                self.online.add_edge(EdgeMeasurement(step, *ends, measured, EdgeKind.ODOMETRY, 0.0, place))

    @rule(robot=robots, seconds=st.sampled_from([2, 900]))
    def set_clock_back(self, robot: str, seconds: int) -> None:
        self.now[robot] -= 1000 * seconds * MILLISECOND
        self.drive(robot, 6, True, True)

    @rule(
        edge_id=ids,
        ends=st.lists(st.tuples(robots, ids, st.booleans()), min_size=2, max_size=2),
        turn=turns,
        precision=st.sampled_from([0.0, 1.0, 1e-12, 1e12]),
        translation=st.sampled_from([None, (0.0, 0.0, 0.0), (math.nan, 0.0, 0.0), (1e9, 0.0, 0.0)]),
    )
    def close(self, edge_id: int, ends: list, turn: tuple, precision: float, translation: tuple | None) -> None:
        source, target = (
            KeyframeReference(robot, stamp_ns=self.now[robot] + (5 - back) * 100 * MILLISECOND)
            if by_stamp
            else KeyframeReference(robot, back)
            for robot, back, by_stamp in ends
        )
        measured = Rotation.from_rotvec(turn).as_quat().tolist()
        self.sent.append(
            EdgeMeasurement(edge_id, source, target, measured, EdgeKind.LOOP_CLOSURE, precision, translation)
        )
        self.online.add_edge(self.sent[-1])

    @rule(which=st.integers(0, 50), reverse=st.booleans())
    def repeat(self, which: int, reverse: bool) -> None:
        if not self.sent:
            return
        edge = self.sent[which % len(self.sent)]
        if reverse:
            x, y, z, w = edge.target_from_source
            edge = replace(edge, source=edge.target, target=edge.source, target_from_source=(-x, -y, -z, w))
        self.online.add_edge(edge)

    @rule(edge_id=ids)
    def edge_of_an_unknown_robot(self, edge_id: int) -> None:
        ends = KeyframeReference("nobody", edge_id), KeyframeReference("a", 1)
        self.online.add_edge(EdgeMeasurement(edge_id, *ends, (0, 0, 0, 1)))

    @rule(robot=robots, edge_id=ids, label=st.sampled_from(list(EdgeLabel)))
    def label(self, robot: str, edge_id: int, label: EdgeLabel) -> None:
        self.online.label_edge(robot, edge_id, label)

    @rule(force_cold=st.booleans())
    def tick(self, force_cold: bool) -> None:
        self.judge(self.online.tick(force_cold=force_cold))
        self.online.go_on()

    @rule(
        max_keyframes=st.sampled_from([5, 1000]),
        threshold=st.sampled_from([0.0, 0.5, 1.0]),
        warm=st.booleans(),
        scale=st.sampled_from(["metric", "none"]),
    )
    def change_options(self, max_keyframes: int, threshold: float, warm: bool, scale: str) -> None:
        changed = replace(
            self.online.options,
            max_keyframes=max_keyframes,
            outlier_threshold=threshold,
            warm_start=warm,
            translation_scale=scale,
        )
        self.online.set_options(changed)

    @rule(paused=st.booleans())
    def pause(self, paused: bool) -> None:
        self.online.pause(paused)

    @rule()
    def forget(self) -> None:
        self.online.reset()

    @rule()
    def switch_off_and_on(self) -> None:
        path = Path(self.folder.name, "state.npz")
        self.online.save(path)
        self.online = OnlineEstimator(self.online.options)
        self.online.load(path)

    @invariant()
    def present_orientations_are_rotations(self) -> None:
        for robot in ROBOTS:
            turn = self.online.current_orientation(robot)
            assert turn is None or abs(math.hypot(*turn) - 1) < 1e-9

    def judge(self, answer: Answer | None) -> None:
        """What holds of every answer."""
        if answer is None:
            return
        assert answer.version > self.version
        self.version = answer.version
        np.testing.assert_allclose(np.linalg.norm(answer.world_from_body, axis=1), 1, rtol=0, atol=1e-9)
        keys = set(zip(answer.keyframe_robot.tolist(), answer.keyframe_id.tolist(), strict=True))
        assert len(keys) == len(answer.keyframe_id)
        assert ((answer.outlier_score >= 0) & (answer.outlier_score <= 1)).all()
        self.online.place(answer)

    def teardown(self) -> None:
        self.folder.cleanup()
        self.judge_the_last_answer()

    def judge_the_last_answer(self) -> None:
        """In silence; the graph alone decides."""
        self.online.pause(False)
        last, worked = self.online.tick(force_cold=True), 1.0
        self.judge(last)
        for _ in range(100):
            newer = self.online.tick()
            worked = self.online.go_on()
            self.judge(newer)
            last = newer or last
            if newer is None and not worked:
                break
        assert not worked
        if last is None:
            return
        options, graph = self.online.options, self.online.snapshot().graph
        if options.translation_scale == "none":
            graph = replace(graph, translation=None)
        alone = solve(graph, **options.for_solver)
        np.testing.assert_allclose(last.outlier_score, alone.outlier_score.numpy(), rtol=0, atol=TOLERANCE_SCORE)
        one, other = (Rotation.from_quat(turns) for turns in (last.world_from_body, alone.world_from_body.numpy()))
        for component in range(int(alone.component.max()) + 1):
            nodes = np.flatnonzero(alone.component.numpy() == component)
            first, second = ((turns[nodes[0]].inv() * turns[nodes]) for turns in (one, other))
            assert np.degrees((first.inv() * second).magnitude().max()) < TOLERANCE_DEG


@pytest.mark.parametrize(
    ("length", "examples"), [(12, 15), (30, 5), *(pytest.param(n, 50, marks=pytest.mark.large) for n in (12, 30))]
)
def test_any_calls_in_any_order(length: int, examples: int) -> None:
    limits = settings(max_examples=examples, stateful_step_count=length, derandomize=True)
    run_state_machine_as_test(Calls, settings=limits)
