"""Odometry that begins anew, seen from outside: no false edge, a component of its own, nothing published jumps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind

SECOND = 1_000_000_000
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, keyframe_interval_s=0.45)
RESTART = 30


def truth(index: int) -> Rotation:
    return Rotation.from_euler("zx", [170 + 2 * index, 5], degrees=True)


def stamp(index: int) -> int:
    return 1_000 * SECOND + index * SECOND // 10


def feed(estimator: OnlineEstimator, start: int, stop: int) -> list[str]:
    """Odometry of a robot that is started again at ``RESTART``; returns what was refused."""
    refused = []
    for index in range(start, stop):
        first = 0 if index < RESTART else RESTART
        odometry = truth(index) if index < RESTART else truth(first).inv() * truth(index)
        position = (5 + 0.1 * index if index < RESTART else 0.1 * (index - RESTART), 0.0, 0.0)
        reason = estimator.add_odometry("r", stamp(index), odometry.as_quat().tolist(), position)
        refused += [reason.value] if reason else []
    return refused


def orientation(estimator: OnlineEstimator) -> Rotation:
    return Rotation.from_quat(estimator.current_orientation("r"))


def closure(source: int, target: int) -> EdgeMeasurement:
    ends = (KeyframeReference("r", stamp_ns=stamp(index)) for index in (source, target))
    return EdgeMeasurement(7, *ends, (truth(target).inv() * truth(source)).as_quat().tolist())


@pytest.fixture(params=["odometry", "identity"])
def estimator(request, solver) -> OnlineEstimator:
    options = EstimatorOptions(**(vars(OPTIONS) | {"gauge": request.param}))
    return OnlineEstimator(options, solver)


@pytest.mark.parametrize("answered_between", [False, True])
def test_the_orientation_goes_on_and_no_edge_is_made(estimator, answered_between):
    assert feed(estimator, 0, RESTART) == []
    estimator.tick()
    before = orientation(estimator)
    assert feed(estimator, RESTART, RESTART + 2) == ["odometry_jump"]
    if answered_between:
        estimator.tick()
    assert math.degrees((before.inv() * orientation(estimator)).magnitude()) < 1e-6  # nothing is known of the turn
    feed(estimator, RESTART + 2, 60)
    turned = orientation(estimator)
    answer = estimator.tick(force_cold=True)
    assert answer.num_components == 2
    assert math.degrees((turned.inv() * orientation(estimator)).magnitude()) < 1e-6
    crossing = [
        (source, target)
        for source, target in zip(answer.source.tolist(), answer.target.tolist(), strict=True)
        if (answer.stamp_ns[source] < stamp(RESTART)) != (answer.stamp_ns[target] < stamp(RESTART))
    ]
    assert crossing == []
    assert set(answer.kind.tolist()) == {EdgeKind.ODOMETRY}
    steps = np.linalg.norm(np.diff(estimator.trajectories(answer)["r"].position, axis=0), axis=1)
    assert steps.max() < 0.6


def test_a_closure_joins_what_came_before_and_after(estimator):
    feed(estimator, 0, 60)
    assert estimator.tick().num_components == 2
    assert estimator.add_edge(closure(7, 52)) is None
    answer = estimator.tick()
    assert answer.num_components == 1
    between = orientation(estimator).inv() * Rotation.from_quat(answer.world_from_body[0])
    expected = truth(59).inv() * truth(0)
    assert math.degrees((between.inv() * expected).magnitude()) < 1e-6


def test_a_saved_state_knows_where_the_new_chain_begins(estimator, solver, tmp_path):
    feed(estimator, 0, RESTART + 5)
    estimator.save(tmp_path / "state.npz")
    restored = OnlineEstimator(estimator.options, solver)
    restored.load(tmp_path / "state.npz")
    assert restored.current_orientation("r") == pytest.approx(estimator.current_orientation("r"))
    for each in (estimator, restored):
        feed(each, RESTART + 5, 60)
    np.testing.assert_allclose(restored.tick().world_from_body, estimator.tick().world_from_body, atol=1e-12)


@pytest.mark.parametrize("mounting", [[0, 0, 0], [90, 0, 0], [-90, 0, -90]])
@pytest.mark.parametrize("is_restored", [False, True])
def test_odometry_of_a_mounted_sensor_begins_anew_where_the_sensor_is_at_zero(solver, mounting, is_restored, tmp_path):
    """A camera's odometry begins at the camera's zero, which is no zero of the body's orientation."""
    body_from_sensor = Rotation.from_euler("zyx", mounting, degrees=True)

    def drive(estimator: OnlineEstimator, first: int) -> None:
        for index in range(40):
            turned = Rotation.from_euler("z", 3 * index, degrees=True)  # of the body since the start
            place = body_from_sensor.inv().apply([0.2 * index, 0.0, 0.0])
            world_from_body = body_from_sensor.inv() * turned
            estimator.add_odometry(
                "r", stamp(first + index), world_from_body.as_quat(), place, body_from_sensor.as_quat()
            )

    estimator = OnlineEstimator(OPTIONS, solver)
    drive(estimator, 0)
    if is_restored:
        estimator.save(tmp_path / "state.npz")
        estimator = OnlineEstimator(OPTIONS, solver)
        estimator.load(tmp_path / "state.npz")
    drive(estimator, 70)
    assert estimator.counts().odometry_restarts == 1


def test_edges_stamped_years_ahead_let_nothing_waiting_go(solver):
    options = EstimatorOptions(keyframe_source="edges")
    estimator = OnlineEstimator(options, solver)

    def odometry(keyframe: int, stamp_ns: int) -> EdgeMeasurement:
        ends = (KeyframeReference("r", k, stamp_ns + k * SECOND) for k in (keyframe, keyframe + 1))
        return EdgeMeasurement(keyframe, *ends, [0, 0, 0, 1], EdgeKind.ODOMETRY)

    estimator.add_edge(odometry(0, 1_000 * SECOND))
    estimator.add_edge(EdgeMeasurement(9, KeyframeReference("r", 0), KeyframeReference("r", 5), [0, 0, 0, 1]))
    estimator.add_edge(odometry(1, 10**9 * SECOND))
    for keyframe in range(2, 5):
        assert estimator.counts().pending == 1
        estimator.add_edge(odometry(keyframe, 1_000 * SECOND))
    assert estimator.counts().pending == 0
    assert estimator.counts().rejected == {}
