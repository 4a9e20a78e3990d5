"""A full graph goes on: what can be spared goes, and everything that hangs on indices follows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.graph import room
from rotavg_ros.online.graph.fingerprints import Fingerprints
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.graph.snapshot import GraphEdge, GraphSnapshot
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

EVERY_MESSAGE = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, max_turn_rate=0, max_speed=0)
SECOND = 1_000_000_000
FALSE = 7.0  # precision of a closure that the solver below judges false


class Drive:
    """Noise-free odometry of two robots, and closures; every other one of these by stamp."""

    def __init__(self, estimator: OnlineEstimator, length: int, seed: int = 0) -> None:
        self.estimator, self.rng = estimator, np.random.default_rng(seed)
        self.truth = {robot: Rotation.random(length, rng=self.rng) for robot in "ab"}
        self.place = {robot: self.rng.normal(size=(length, 3)) for robot in "ab"}
        self.now = 0

    def go(self, steps: int) -> None:
        for _ in range(steps):
            for robot in "ab":
                pose = self.truth[robot][self.now].as_quat().tolist(), self.place[robot][self.now]
                assert self.estimator.add_odometry(robot, self.now * SECOND, *pose) is None
            self.now += 1

    def close(self, edge_id: int, source: tuple[str, int], target: tuple[str, int], **values: object) -> object:
        first, second = (self.truth[robot][index] for robot, index in (source, target))
        by_stamp = edge_id % 2 == 0
        ends = [
            KeyframeReference(robot, stamp_ns=index * SECOND) if by_stamp else KeyframeReference(robot, index)
            for robot, index in (source, target)
        ]
        step = first.inv().apply(self.place[target[0]][target[1]] - self.place[source[0]][source[1]])
        edge = EdgeMeasurement(edge_id, *ends, (second.inv() * first).as_quat(), translation=step)
        return self.estimator.add_edge(replace(edge, **values))

    def close_some(self, count: int) -> None:
        for _ in range(count):
            source, target = (("ab"[self.rng.integers(2)], int(self.rng.integers(self.now))) for _ in range(2))
            if source != target:
                false = self.rng.random() < 0.3
                self.close(self.next_id(), source, target, precision=FALSE if false else 1.0)

    def next_id(self) -> int:
        self.last_id = getattr(self, "last_id", 0) + 1
        return self.last_id


@pytest.fixture
def judging(solver):
    """The solver, checking what it is given: a warm start fits every edge, and false closures are found."""

    def solve(graph, *, warm_start, **options):
        if warm_start is not None:
            residual = edge_residual(warm_start, graph.target_from_source, graph.source, graph.target)
            assert float(rotations.angle(residual).max()) < 1e-6
        solution = solver(graph, warm_start=warm_start, **options)
        return replace(solution, outlier_score=(graph.precision == FALSE).double())

    return solve


def check(drive: Drive) -> None:
    """The answer, the graph and the flags agree with the truth."""
    estimator = drive.estimator
    answer = estimator.tick()
    if answer is None:
        return
    for keyframe, robot, orientation in zip(
        answer.keyframe_id.tolist(), answer.keyframe_robot, answer.world_from_body, strict=True
    ):
        truth = drive.truth[answer.robots[robot]][keyframe]
        assert (Rotation.from_quat(orientation) * truth.inv()).magnitude() < 1e-6
    poses = estimator.trajectories(answer)["a"]
    np.testing.assert_allclose(poses.position_dead_reckoned, drive.place["a"][poses.stamp_ns // SECOND], atol=1e-6)
    snapshot, flags = estimator.snapshot(), estimator._content.state.last.outlier
    np.testing.assert_array_equal(flags, snapshot.graph.precision.numpy()[: len(flags)] == FALSE)
    for robot in "ab":
        present = Rotation.from_quat(estimator.current_orientation(robot))
        assert (present * drive.truth[robot][drive.now - 1].inv()).magnitude() < 1e-6


def test_indices_follow_even_while_a_solve_is_under_way(judging, solver, tmp_path):
    estimator = OnlineEstimator(replace(EVERY_MESSAGE, max_keyframes=60, gauge="odometry"), judging)
    drive = Drive(estimator, 500)
    drive.go(5)
    drive.close(drive.next_id(), ("a", 2), ("b", 3))

    def meanwhile() -> None:
        drive.go(7)
        drive.close_some(8)

    solver.on_call = meanwhile
    first = None
    while drive.now < 300:
        drive.go(3)
        check(drive)
        assert estimator.counts().keyframes <= 60
        first = first or estimator.snapshot().keyframe_id[:2].tolist()
        if 150 <= drive.now < 160:
            estimator.save(tmp_path / "state")
            estimator.load(tmp_path / "state")
    counts = estimator.counts()
    assert counts.marginalized > 400 and counts.dropped_closures > 20 and solver.warm > 20
    assert estimator.snapshot().keyframe_id[:2].tolist() == first == [0, 0]
    solver.on_call = None
    assert estimator.tick(force_cold=True).num_components == 1


def test_a_closure_to_a_marginalized_keyframe_is_tied_to_the_nearest_that_is_left(solver, monkeypatch):
    monkeypatch.setattr(room, "_REMEMBERED_AT_LEAST", 100)
    estimator = OnlineEstimator(replace(EVERY_MESSAGE, max_keyframes=30), solver)
    drive = Drive(estimator, 400)
    drive.go(60)
    left = set(estimator.snapshot().keyframe_id[estimator.snapshot().keyframe_robot == 0].tolist())
    gone = [keyframe for keyframe in range(40) if keyframe not in left]
    for edge_id in (1, 2):
        assert drive.close(edge_id, ("a", gone[edge_id]), ("b", 59)) is None
        assert drive.close(edge_id, ("a", gone[edge_id]), ("b", 59)) == "duplicate_edge"
        graph = estimator.snapshot()
        source, target = (int(end[-1]) for end in (graph.graph.source, graph.graph.target))
        nearest = int(graph.keyframe_id[source])
        assert graph.keyframe_robot[source] == 0 and int(graph.keyframe_id[target]) == 59
        assert abs(nearest - gone[edge_id]) == min(abs(keyframe - gone[edge_id]) for keyframe in left)
        truth = drive.truth["b"][59].inv() * drive.truth["a"][nearest]
        tied = Rotation.from_quat(graph.graph.target_from_source[-1].numpy())
        assert (tied * truth.inv()).magnitude() < 1e-6
        step = drive.truth["a"][nearest].inv().apply(drive.place["b"][59] - drive.place["a"][nearest])
        np.testing.assert_allclose(graph.translation[-1], step, atol=1e-6)
    assert drive.close(3, ("a", gone[2]), ("a", gone[2] + 1), kind=EdgeKind.ODOMETRY) == "marginalized_keyframe"
    drive.go(90)
    assert drive.close(5, ("a", gone[5]), ("b", 59)) == "marginalized_keyframe"  # so long ago that it is forgotten
    assert estimator.counts().pending == 0


def test_keyframes_of_a_front_end_are_spared_too_and_not_made_anew(solver):
    options = replace(EVERY_MESSAGE, keyframe_source="edges", unknown_keyframes="create", max_keyframes=40)
    estimator = OnlineEstimator(options, solver)
    turn = Rotation.from_rotvec([0.1, 0.0, 0.2])
    for index in range(200):
        ends = KeyframeReference("r", index, index * SECOND), KeyframeReference("r", index + 1, (index + 1) * SECOND)
        estimator.add_edge(EdgeMeasurement(index, *ends, turn.as_quat(), kind=0, precision=4.0))
    before = estimator.snapshot()
    assert len(before.keyframe_id) <= 40
    assert before.graph.steps.sum() == 200 and torch.allclose(before.graph.precision, 4.0 / before.graph.steps)
    gone = next(keyframe for keyframe in range(80, 200) if keyframe not in before.keyframe_id)
    ends = KeyframeReference("r", 0), KeyframeReference("r", stamp_ns=gone * SECOND)
    assert estimator.add_edge(EdgeMeasurement(999, *ends, (turn**gone).as_quat())) is None
    after = estimator.snapshot()
    node = int(after.graph.target[-1])
    assert len(after.keyframe_id) == len(before.keyframe_id) and abs(int(after.keyframe_id[node]) - gone) <= 20
    tied = Rotation.from_quat(after.graph.target_from_source[-1].numpy())
    assert (tied * (turn ** int(after.keyframe_id[node])).inv()).magnitude() < 1e-6


def test_what_users_accepted_and_what_holds_the_graph_together_stays(judging):
    estimator = OnlineEstimator(replace(EVERY_MESSAGE, max_keyframes=50), judging)
    drive = Drive(estimator, 400)
    drive.go(10)
    drive.close(1, ("a", 3), ("b", 4), precision=FALSE)  # the only bridge
    drive.close(3, ("a", 2), ("a", 8), precision=FALSE)
    estimator.label_edge("a", 3, EdgeLabel.ACCEPTED)
    drive.last_id = 4
    while drive.now < 200:
        drive.go(10)
        for back in (3, 5):
            drive.close(drive.next_id(), ("a", drive.now - back - 2), ("a", drive.now - 1))
        estimator.tick()
    answer = estimator.tick(force_cold=True)
    assert answer.num_components == 1 and {1, 3} <= set(answer.edge_id.tolist())
    assert estimator.counts().dropped_closures > 0


def odometry_of(run: SimulatedRun) -> Iterator[tuple[int, list[float], np.ndarray]]:
    return zip(run.stamps_ns.tolist(), run.odometry_world_from_body.tolist(), run.odometry_position, strict=True)


@pytest.mark.large
def test_a_long_drive_with_a_limit_is_hardly_less_accurate():
    config = SlamSimulationConfig(
        World.CITY, num_keyframes=800, laps=4, keyframe_distance_m=2.0, closures_per_keyframe=0.3, false_share=0.1
    )
    run = simulate_slam_graph(config, np.random.default_rng(1006))
    graph, truth = run.graph, Rotation.from_quat(run.world_from_body)
    closures = np.flatnonzero(graph.kind.numpy() == EdgeKind.LOOP_CLOSURE)
    due = np.maximum(graph.source.numpy(), graph.target.numpy())[closures]
    errors = {}
    for limit in (300, 10**6):
        estimator = OnlineEstimator(replace(EVERY_MESSAGE, max_keyframes=limit))
        for index, odometry in enumerate(odometry_of(run)):
            estimator.add_odometry("r", *odometry)
            for edge in closures[due == index].tolist():
                ends = (KeyframeReference("r", int(end[edge])) for end in (graph.source, graph.target))
                assert estimator.add_edge(EdgeMeasurement(edge, *ends, graph.target_from_source[edge].tolist())) is None
            assert estimator.counts().keyframes <= limit
            if index % 100 == 99:
                estimator.tick()
        answer = estimator.tick(force_cold=True)
        nodes = answer.keyframe_id.astype(int)
        off = Rotation.from_quat(answer.world_from_body) * truth[nodes].inv() * truth[0]
        off = off * (Rotation.from_quat(answer.world_from_body[0])).inv()
        errors[limit] = dict(zip(nodes.tolist(), np.degrees(off.magnitude()), strict=True))
    kept = list(errors[300])
    limited, free = (np.mean([errors[limit][node] for node in kept]) for limit in (300, 10**6))
    drift = Rotation.from_quat(run.odometry_world_from_body) * truth.inv()
    drifted = np.degrees((drift[kept] * drift[0].inv()).magnitude().mean())
    assert limited < 1.5 * free + 0.2 and limited < 0.2 * drifted


def test_keyframes_that_no_closure_touches_are_not_missed(tmp_path):
    """With translations, and odometry that errs in turns; nor once the state was saved and loaded."""
    drawn = next(kind for kind in KINDS if kind.name == "hills: odometry worse in turns").drawn(3)
    graph, place = drawn.graph, drawn.edge_translation
    source, target = graph.source.numpy(), graph.target.numpy()
    is_odometry = graph.is_odometry.numpy()
    # The rotations that odometry's own rounding leaves, in messages of poses.
    pose = [Rotation.identity()]
    position = [np.zeros(3)]
    for edge in np.flatnonzero(is_odometry):
        assert target[edge] == source[edge] + 1 == len(pose)
        position.append(position[-1] + pose[-1].apply(place[edge]))
        pose.append(pose[-1] * Rotation.from_quat(graph.target_from_source[edge].numpy()).inv())
    estimator = OnlineEstimator(EVERY_MESSAGE)
    for index, orientation in enumerate(pose):
        estimator.add_odometry("r", index * SECOND, orientation.as_quat().tolist(), position[index])
    for edge in np.flatnonzero(~is_odometry).tolist():
        ends = (KeyframeReference("r", int(end[edge])) for end in (source, target))
        measured = graph.target_from_source[edge].tolist()
        assert (
            estimator.add_edge(EdgeMeasurement(edge, *ends, measured, translation=tuple(place[edge].tolist()))) is None
        )
    all_of_them = estimator.tick(force_cold=True)
    estimator.set_options(replace(EVERY_MESSAGE, max_keyframes=350))
    estimator.add_odometry("r", len(pose) * SECOND, pose[-1].as_quat().tolist(), position[-1])
    counts = estimator.counts()
    assert counts.marginalized > 100 and counts.dropped_closures == 0
    estimator.save(tmp_path / "state")
    estimator = OnlineEstimator(replace(EVERY_MESSAGE, max_keyframes=350))
    estimator.load(tmp_path / "state")
    few = estimator.tick(force_cold=True)
    known = few.keyframe_id < len(pose)
    at = few.keyframe_id[known].astype(int)
    off = Rotation.from_quat(few.world_from_body[known]) * Rotation.from_quat(all_of_them.world_from_body[at]).inv()
    assert (off.magnitude()[1:] / all_of_them.uncertainty[at][1:]).max() < 0.15


def test_fingerprints_hold_the_newest_and_forget_the_oldest():
    known = Fingerprints(10_000)
    numbers = np.random.default_rng(0).integers(0, 2**64, 50_000, dtype=np.uint64).tolist()
    for number in numbers:
        known.add(number)
    assert all(number in known for number in numbers[-10_000:])
    assert not any(number in known for number in numbers[:1000]) and 5 not in known
    assert 10_000 <= len(known) <= 20_000 + 4096
    again = Fingerprints.from_arrays(10_000, known.arrays())
    for number in range(20_000):
        known.add(number)
        again.add(number)
        assert (numbers[-5_000] in again) == (numbers[-5_000] in known)


def test_odometry_goes_on_from_a_keyframe_that_edges_named_long_before_it_came(solver):
    """It is not among the latest then, and may lie between two edges of odometry."""
    options = replace(EVERY_MESSAGE, unknown_keyframes="create", max_keyframes=40)
    estimator = OnlineEstimator(options, solver)
    for keyframe_id in range(30, 45):
        ends = KeyframeReference("a", keyframe_id), KeyframeReference("a", keyframe_id + 1000)
        estimator.add_edge(EdgeMeasurement(keyframe_id, *ends, (0, 0, 0, 1), EdgeKind.ODOMETRY))
    Drive(estimator, 60).go(60)
    assert estimator.counts().marginalized > 40
    graph = estimator.snapshot()
    assert len(graph.keyframe_id) <= 40 and {59} <= set(graph.keyframe_id[graph.keyframe_robot == 0].tolist())


def edge(edge_id: int, source: int, target: int, turn: float, kind: EdgeKind) -> EdgeMeasurement:
    """Of a front end's keyframes, a second apart; ``turn``: radians from the source to the target about z."""
    ends = (KeyframeReference("r", end, (end + 1) * SECOND) for end in (source, target))
    return EdgeMeasurement(edge_id, *ends, (0.0, 0.0, np.sin(-turn / 2), np.cos(turn / 2)), kind)


TWO_ODOMETRIES, TWO_BEFORE, EIGHT_BEFORE = [(1, 1.0), (1, 1.01)], [(1, 1.0), (2, 1.0)], [(i, 1.0) for i in range(1, 9)]


@pytest.mark.parametrize("links", [TWO_ODOMETRIES, TWO_BEFORE, EIGHT_BEFORE])
def test_odometry_that_a_front_end_states_more_than_once_costs_no_closure(solver, links) -> None:
    """A full graph goes on with new keyframes; an odometry that scales turns by 1.01 stays one by itself.

    With eight links for each keyframe the graph is full of edges first.
    """
    options = EstimatorOptions(keyframe_source="edges", max_keyframes=100)
    estimator = OnlineEstimator(options, solver)
    step, closures = 0.1, 0
    for target in range(1, 300):
        for span, scale in links:
            if target >= span:
                link = edge(target, target - span, target, span * scale * step, EdgeKind.ODOMETRY)
                assert estimator.add_edge(link) is None
            assert estimator.counts().edges <= options.most_edges
        if target > 60 and target % 10 == 0:
            closures += 1
            closure = edge(1000 + target, target - 60, target, 60 * step, EdgeKind.LOOP_CLOSURE)
            assert estimator.add_edge(closure) is None
    left, counts = estimator.snapshot(), estimator.counts()
    assert len(left.keyframe_id) + counts.marginalized == 300 and not counts.is_full
    is_closure = ~left.graph.is_odometry.numpy()
    assert counts.dropped_closures == 0 and is_closure.sum() == closures
    way = left.keyframe_id[left.graph.target] - left.keyframe_id[left.graph.source].astype(float)
    turned = rotations.log(left.graph.target_from_source)[:, 2].numpy() / step + way
    off = np.abs(turned - 2 * np.pi / step * np.round(turned / (2 * np.pi / step)))
    if links is TWO_ODOMETRIES:
        pairs = np.unique(np.stack((left.graph.source, left.graph.target))[:, ~is_closure], axis=1, return_counts=True)
        assert (pairs[1] == 2).all()
        scaled = np.flatnonzero(off > 1e-6)
        assert 2 * len(scaled) == (~is_closure).sum()
        np.testing.assert_allclose(off[scaled], 0.01 * way[scaled], atol=1e-6)
    else:
        assert off.max() < 1e-6


def test_a_closure_goes_for_a_keyframe_that_goes_and_for_no_other(solver) -> None:
    """Odometry that a user has accepted holds its keyframes, whatever closures are dropped."""
    rng = np.random.default_rng(0)
    for accepted in (200, 100):
        estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges", max_keyframes=150), solver)
        ends: dict[int, tuple[int, int]] = {}
        for target in range(1, 200):
            estimator.add_edge(edge(target, target - 1, target, 0.1, EdgeKind.ODOMETRY))
            if target < accepted:
                estimator.label_edge("r", target, EdgeLabel.ACCEPTED)
            if 20 < target < 140:
                for number in (1000 + target, 2000 + target):
                    source = int(rng.integers(target - 10))
                    assert estimator.add_edge(edge(number, source, target, 0.1 * (target - source), 1)) is None
                    ends[number] = source, target
        left, counts = estimator.snapshot(), estimator.counts()
        kept, keyframes = {*left.edge_id.tolist()}, {*left.keyframe_id.tolist()}
        gone = {number for number in ends if number not in kept}
        assert counts.dropped_closures == len(gone) and (counts.marginalized == 0) == (accepted == 200)
        assert all({*ends[number]} - keyframes for number in gone)
        assert counts.is_full or accepted != 200


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 3))
def test_whatever_odometry_there_is_what_stays_is_true_and_as_connected_as_it_was(seed: int, robots: int) -> None:
    """Odometry without noise between any keyframes, some of it labelled, thinned three times and added to meanwhile."""
    rng = np.random.default_rng(seed)
    growing, pose = GrowingViewGraph(), Rotation.random(80, rng=rng)
    robot_of, place = [f"{rng.integers(robots)}" for _ in range(80)], rng.normal(size=(80, 3))

    def add(kind: EdgeKind, source: int, target: int) -> None:
        ends = (growing.node(robot_of[end], end) for end in (source, target))
        if source != target and None not in (ends := tuple(ends)):
            turn = (pose[target].inv() * pose[source]).as_quat()
            shift = pose[source].inv().apply(place[target] - place[source])
            label = EdgeLabel.ACCEPTED if rng.random() < 0.05 else EdgeLabel.AUTOMATIC
            growing.add_edge(GraphEdge(*ends, tuple(turn), kind, label, translation=tuple(shift)))

    for later in (40, 60, 80):
        for keyframe in range(later - 40 if later == 40 else later - 20, later):
            growing.add_keyframe(robot_of[keyframe], keyframe)
            for _ in range(rng.integers(1, 4)):
                add(EdgeKind.ODOMETRY, keyframe, max(0, keyframe - int(rng.integers(1, 4))))
            if rng.random() < 0.3:
                add(EdgeKind.LOOP_CLOSURE, keyframe, int(rng.integers(later)))
        before = growing.snapshot()
        verdict = rng.integers(0, 3, growing.num_edges).astype(np.int8)
        growing.compact(int(rng.integers(20)), int(rng.integers(2) * rng.integers(30)), verdict, 1000, [])
        check_true(growing.snapshot(), pose, place)
        check_as_connected(before, growing.snapshot())


def check_true(left: GraphSnapshot, pose: Rotation, place: np.ndarray) -> None:
    """Edges and the poses of marginalised keyframes are those of the true poses."""
    ids, graph, riders = left.keyframe_id.astype(int), left.graph, left.marginalized.keyframes
    source, target = ids[graph.source.numpy()], ids[graph.target.numpy()]
    turned = Rotation.from_quat(graph.target_from_source.numpy()) * (pose[target].inv() * pose[source]).inv()
    assert turned.magnitude().max() < 1e-7
    shift = pose[source].inv().apply(place[target] - place[source])
    np.testing.assert_allclose(left.translation, shift, atol=1e-7)
    gone = riders.keyframe_id.astype(int)
    assert not {*gone.tolist()} & {*ids.tolist()} and len(gone) + len(ids) == max([*ids.tolist(), *gone.tolist()]) + 1
    if len(gone):
        on = source[riders.edge]
        turned = Rotation.from_quat(riders.keyframe_from_source) * (pose[gone].inv() * pose[on]).inv()
        assert turned.magnitude().max() < 1e-7
        np.testing.assert_allclose(riders.position, pose[on].inv().apply(place[gone] - place[on]), atol=1e-7)


def check_as_connected(before: GraphSnapshot, after: GraphSnapshot) -> None:
    """Keyframes that are left are in one component of odometry, or of all edges, if they were."""
    row = np.searchsorted(before.keyframe_id, after.keyframe_id)
    for chosen in ("odometry", "all"):
        component = [
            (each.graph.select_edges(each.graph.is_odometry) if chosen == "odometry" else each.graph).components()
            for each in (before, after)
        ]
        pairs = {*zip(component[0][row].tolist(), component[1].tolist(), strict=True)}
        assert len(pairs) == len({old for old, _ in pairs}) == len({new for _, new in pairs})
