"""A robot that is switched off and on: today's map is a component of its own until a closure joins it."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind

SECOND = 1_000_000_000
DAY = 86_400
YESTERDAY = 1_790_000_000  # seconds since 1970
LENGTH = 60
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0)


def truth(index: int) -> Rotation:
    """Of the body in the world; yesterday ends and today begins at ``LENGTH``, turned by half a turn."""
    return Rotation.from_euler("zx", [170 + 3 * index, 5], degrees=True)


def drive(estimator: OnlineEstimator, first: int, stop: int, start_s: float, away_m: float = 5.0) -> None:
    """Odometry that begins at zero with message ``first``, ten messages a second."""
    for index in range(first, stop):
        turn = (truth(first).inv() * truth(index)).as_quat().tolist()
        stamp_ns = round(start_s * SECOND) + (index - first) * SECOND // 10
        position = (away_m * math.sin(0.05 * (index - first)), 0.0, 0.0)
        estimator.add_odometry("r", stamp_ns, turn, position)


@pytest.fixture
def restarted(solver, tmp_path) -> Callable[[OnlineEstimator], OnlineEstimator]:
    """The estimator of the same options that goes on from the state of another one."""

    def begun_after(before: OnlineEstimator) -> OnlineEstimator:
        before.save(tmp_path / "state.npz")
        after = OnlineEstimator(before.options, solver)
        after.load(tmp_path / "state.npz")
        return after

    return begun_after


def odometry_edges_across(answer: Answer, first_of_today: int) -> int:
    ids = answer.keyframe_id
    across = (ids[answer.source] < first_of_today) != (ids[answer.target] < first_of_today)
    return int((across & (answer.kind == EdgeKind.ODOMETRY)).sum())


@pytest.fixture
def yesterday(solver) -> OnlineEstimator:
    estimator = OnlineEstimator(OPTIONS, solver)
    drive(estimator, 0, LENGTH, YESTERDAY)
    estimator.tick()
    return estimator


END = YESTERDAY + LENGTH / 10
TODAY = {
    "in the same second": END + 0.6,
    "half a minute later": END + 30.0,
    "a day later": YESTERDAY + DAY,
    "an hour back": YESTERDAY - 3600.0,
    "two seconds back": END - 2.0,
    "in 1970": 10.0,
}


@pytest.mark.parametrize("today_s", TODAY.values(), ids=TODAY.keys())
def test_today_is_a_component_until_a_closure_joins_it(yesterday, restarted, today_s) -> None:
    estimator = restarted(yesterday)
    drive(estimator, LENGTH, 2 * LENGTH, today_s)
    answer = estimator.tick()
    today = len(answer.keyframe_id) - LENGTH
    assert today >= LENGTH - 1, "yesterday's map is kept, and of today's messages one is refused at most"
    assert answer.num_components == 2 and odometry_edges_across(answer, LENGTH) == 0
    first = int(answer.keyframe_id[LENGTH])
    skipped = LENGTH - today
    by_id = (KeyframeReference("r", 7), KeyframeReference("r", first + 20))
    true = truth(LENGTH + skipped + 20).inv() * truth(7)
    assert estimator.add_edge(EdgeMeasurement(1, *by_id, true.as_quat().tolist())) is None
    joined = estimator.tick()
    assert joined.num_components == 1
    between = Rotation.from_quat(joined.world_from_body[-1]).inv() * Rotation.from_quat(joined.world_from_body[0])
    assert math.degrees((between.inv() * truth(2 * LENGTH - 1).inv() * truth(0)).magnitude()) < 1e-6


@pytest.mark.parametrize("today_s", TODAY.values(), ids=TODAY.keys())
def test_closures_by_stamp_join_the_two(yesterday, restarted, today_s) -> None:
    """Also those to stamps that today's clock has not come to yet, or left behind long ago."""
    estimator = restarted(yesterday)
    drive(estimator, LENGTH, 2 * LENGTH, today_s)
    stamps = [YESTERDAY + 0.7, today_s + 2.0]
    source, target = (KeyframeReference("r", stamp_ns=round(stamp * SECOND)) for stamp in stamps)
    true = truth(LENGTH + 20).inv() * truth(7)
    assert estimator.add_edge(EdgeMeasurement(1, source, target, true.as_quat().tolist())) is None
    joined = estimator.tick()
    assert joined.num_components == 1
    between = Rotation.from_quat(joined.world_from_body[-1]).inv() * Rotation.from_quat(joined.world_from_body[0])
    assert math.degrees((between.inv() * truth(2 * LENGTH - 1).inv() * truth(0)).magnitude()) < 1e-6


@pytest.mark.parametrize("parked_m", [0.0, 0.05, 0.8])
def test_a_robot_that_was_parked_where_it_began(solver, restarted, parked_m) -> None:
    """There odometry that begins at zero is no jump, so only the restart tells."""
    yesterday = OnlineEstimator(OPTIONS, solver)
    for index in range(LENGTH):
        out = parked_m + 3 * math.sin(math.pi * index / (LENGTH - 1))
        yesterday.add_odometry("r", YESTERDAY * SECOND + index * SECOND // 10, (0, 0, 0, 1), (out, 0, 0))
    estimator = restarted(yesterday)
    drive(estimator, LENGTH, 2 * LENGTH, END + 20)
    answer = estimator.tick()
    assert answer.num_components == 2 and odometry_edges_across(answer, LENGTH) == 0


@pytest.mark.parametrize("missed", [0, 400])
def test_odometry_that_ran_on_while_the_node_was_down_is_joined(yesterday, restarted, missed) -> None:
    """The robot went on, or drove about for 40 seconds and is two metres from where it was."""
    estimator = restarted(yesterday)
    for index in range(LENGTH, LENGTH + 20):
        turn = (truth(0).inv() * truth(index)).as_quat().tolist()
        position = (5.0 * math.sin(0.05 * index), 2.0 if missed else 0.0, 0.0)
        stamp_ns = YESTERDAY * SECOND + (missed + index) * SECOND // 10
        assert estimator.add_odometry("r", stamp_ns, turn, position) is None
    answer = estimator.tick()
    assert answer.num_components == 1 and odometry_edges_across(answer, LENGTH) == 1


@pytest.mark.parametrize(("moved_m", "components"), [(0.0, 1), (0.05, 1), (0.5, 2)])
def test_after_a_longer_break_only_the_very_same_pose_shows_that_it_ran_on(
    yesterday, restarted, moved_m, components
) -> None:
    estimator = restarted(yesterday)
    start = YESTERDAY * SECOND + LENGTH * SECOND // 10 + 3600 * SECOND
    pose = (truth(0).inv() * truth(LENGTH - 1)).as_quat().tolist()
    parked_m = 5.0 * math.sin(0.05 * (LENGTH - 1))
    for index in range(20):
        estimator.add_odometry("r", start + index * SECOND // 10, pose, (parked_m + moved_m, 0, 0))
    assert estimator.tick().num_components == components


@pytest.mark.parametrize("today_s", TODAY.values(), ids=TODAY.keys())
def test_the_orientation_and_the_path_go_on_from_where_the_robot_was(yesterday, restarted, today_s) -> None:
    estimator = restarted(yesterday)
    before = Rotation.from_quat(estimator.current_orientation("r"))
    drive(estimator, LENGTH, LENGTH + 30, today_s)
    turned = (Rotation.from_quat(estimator.current_orientation("r")) * before.inv()).magnitude()
    assert math.degrees(turned) < 3 * 31, "from there on by what odometry says, with no jump"
    answer = estimator.tick()
    trajectory = estimator.trajectories(answer)["r"]
    assert trajectory.node.tolist() == list(range(len(answer.keyframe_id))), "in order of time, whatever the stamps"
    newest_s = today_s + 2.9
    assert answer.newest_stamp_ns == pytest.approx(newest_s * SECOND, abs=SECOND // 10)


def test_a_power_cycle_every_day_for_a_week(solver, restarted) -> None:
    """Also twice at zero with the same stamps: three time lines may cover a stamp, and the latest is meant."""
    estimator = OnlineEstimator(OPTIONS, solver)
    starts = [YESTERDAY, YESTERDAY, YESTERDAY + DAY, 5, 5, YESTERDAY, YESTERDAY + 2 * DAY]
    for day, start_s in enumerate(starts):
        drive(estimator, day * LENGTH, (day + 1) * LENGTH, start_s)
        estimator.tick()
        estimator = restarted(estimator)
    answer = estimator.tick(force_cold=True)
    assert answer.num_components == 7
    edge = EdgeMeasurement(
        1,
        KeyframeReference("r", stamp_ns=7 * SECOND),
        KeyframeReference("r", stamp_ns=round(SECOND * (YESTERDAY + 2 * DAY + 2))),
        (0.0, 0.0, 0.0, 1.0),
    )
    assert estimator.add_edge(edge) is None
    graph = estimator.snapshot()
    source = int(graph.graph.source[-1])
    assert graph.time_line[source] == graph.time_line[graph.stamp_ns == 7 * SECOND].max()
