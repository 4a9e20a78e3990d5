"""Where odometry's frame lies: on the corrected path at every answer, going on from there until the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.answer.odometry_frame import Drift, OdometryFrame

SECOND = 1_000_000_000
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, keyframe_interval_s=0.25)
LAP = 60


@dataclass(frozen=True)
class Drive:
    """A robot that goes round in a circle at 10 Hz: true poses, and odometry that drifts in a frame of its own."""

    stamps: list[int]
    truth: Rotation
    position: np.ndarray
    odometry: Rotation
    odometry_position: np.ndarray

    @property
    def length(self) -> int:
        return len(self.stamps)

    def feed(self, estimator: OnlineEstimator, start: int = 0, stop: int | None = None, robot: str = "r") -> None:
        for index in range(start, self.length if stop is None else stop):
            orientation, position = self.odometry[index].as_quat().tolist(), self.odometry_position[index].tolist()
            assert estimator.add_odometry(robot, self.stamps[index], orientation, position) is None

    def close(self, estimator: OnlineEstimator, index: int, robot: str = "r", translated: bool = True) -> None:
        """A true closure to where the robot was a lap ago."""
        ends = [index - LAP, index]
        source, target = (KeyframeReference(robot, stamp_ns=self.stamps[end]) for end in ends)
        turn = (self.truth[ends[0]].inv() * self.truth[index]).as_quat().tolist()
        way = self.truth[ends[0]].inv().apply(self.position[index] - self.position[ends[0]]).tolist()
        edge = EdgeMeasurement.from_ros(index, source, target, turn, way if translated else None)
        assert estimator.add_edge(edge) is None


def drive(length: int = 3 * LAP, planar: bool = True, drift_deg: float = 0.4, seed: int = 0) -> Drive:
    random = np.random.default_rng(seed)
    angle = 2 * math.pi * np.arange(length) / LAP
    tilt = Rotation.from_rotvec([0.0 if planar else 0.3, 0, 0])
    truth = tilt * Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    position = tilt.apply(np.stack((4 * np.cos(angle), 4 * np.sin(angle), 0 * angle), axis=1))
    turns = truth[:-1].inv() * truth[1:]
    ways = truth[:-1].inv().apply(np.diff(position, axis=0)) + random.normal(0, 0.004, (length - 1, 3)) * [1, 1, 0]
    odometry, at = [Rotation.from_rotvec([0, 0, 1.0])], [np.array([30.0, -7.0, 0.0])]
    axes = np.array([0, 0, 1]) if planar else np.ones(3)
    for turn, way, error in zip(turns, ways, random.normal(0, np.radians(drift_deg), (length - 1, 3)), strict=True):
        at.append(at[-1] + odometry[-1].apply(way))
        odometry.append(odometry[-1] * turn * Rotation.from_rotvec(error * axes))
    stamps = (1_700_000_000 * SECOND + np.arange(length) * SECOND // 10).tolist()
    return Drive(stamps, truth, position, Rotation.concatenate(odometry), np.array(at))


def frame_of(estimator: OnlineEstimator, robot: str = "r") -> OdometryFrame:
    placed = estimator.odometry_frame(robot)
    assert placed is not None
    return placed[0]


def answered(estimator: OnlineEstimator) -> Answer:
    answer = estimator.tick()
    assert answer is not None
    return answer


@pytest.mark.parametrize(
    ("planar", "translated"),
    [
        (True, True),
        (False, False),
        *(pytest.param(*case, marks=pytest.mark.large) for case in ((True, False), (False, True))),
    ],
)
def test_at_the_newest_keyframe_of_every_answer_odometry_lies_on_the_corrected_path(planar, translated):
    run, estimator = drive(planar=planar), OnlineEstimator(OPTIONS)
    moved = 0.0
    for start in range(0, run.length, 20):
        run.feed(estimator, start, start + 20)
        for index in range(max(start, LAP), start + 20, 3):
            run.close(estimator, index, translated=translated)
        before = estimator.odometry_frame("r")
        path = estimator.place(answered(estimator))["r"]
        frame = frame_of(estimator)
        newest = run.stamps.index(int(path.stamp_ns[-1]))
        np.testing.assert_allclose(frame.place(tuple(run.odometry_position[newest])), path.position[-1], atol=1e-9)
        turned = Rotation.from_quat(frame.orientation) * run.odometry[newest]
        assert (turned.inv() * Rotation.from_quat(path.world_from_body[-1])).magnitude() < 1e-9
        assert frame.is_planar is planar
        moved = max(moved, math.dist(frame.origin, before[0].origin))
    assert moved > 0.05  # there was something to correct


def test_before_the_first_answer_a_robot_is_where_odometry_says():
    run, estimator = drive(), OnlineEstimator(OPTIONS)
    assert estimator.odometry_frame("r") is None
    run.feed(estimator, 0, 5)
    np.testing.assert_allclose(frame_of(estimator).place(tuple(run.odometry_position[4])), run.odometry_position[4])
    assert frame_of(estimator).orientation == pytest.approx((0, 0, 0, 1))


def test_odometry_without_positions_places_nobody():
    run, estimator = drive(), OnlineEstimator(OPTIONS)
    for index in range(30):
        estimator.add_odometry("r", run.stamps[index], run.odometry[index].as_quat().tolist())
    estimator.place(answered(estimator))
    assert estimator.odometry_frame("r") is None


def test_variances_grow_with_odometry_and_shrink_with_closures():
    run, estimator = drive(length=4 * LAP), OnlineEstimator(OPTIONS)

    def deviations() -> tuple[float, float]:
        frame, steps = estimator.odometry_frame("r")
        at = run.odometry_position[len_fed - 1]
        orientation, position = frame.drift.after(steps, math.dist(at, frame.keyframe_position))
        return math.degrees(math.sqrt(orientation)), math.sqrt(position)

    run.feed(estimator, 0, 2 * LAP)
    for index in range(LAP, 2 * LAP, 3):
        run.close(estimator, index)
    len_fed = 2 * LAP
    estimator.place(answered(estimator))
    known = deviations()
    run.feed(estimator, 2 * LAP, 3 * LAP)
    len_fed = 3 * LAP
    drifted = deviations()
    # 24 keyframes of 0.4° a message, 2.5 messages a keyframe.
    assert known[0] < 2 < drifted[0] < 2 * math.hypot(known[0], 0.4 * math.sqrt(LAP))
    assert drifted[1] > known[1]
    for index in range(2 * LAP, 3 * LAP, 3):
        run.close(estimator, index)
    estimator.place(answered(estimator))
    assert all(now < then for now, then in zip(deviations(), drifted, strict=True))


def test_odometry_that_begins_anew_goes_on_where_the_robot_was():
    run, estimator = drive(), OnlineEstimator(OPTIONS)
    run.feed(estimator, 0, 2 * LAP)
    for index in range(LAP, 2 * LAP, 3):
        run.close(estimator, index)
    estimator.place(answered(estimator))
    last = 2 * LAP - 1
    was = frame_of(estimator).place(tuple(run.odometry_position[last]))
    turned = Rotation.from_quat(estimator.current_orientation("r"))
    for index in range(3):  # far from where it was, and turned
        stamp = run.stamps[last] + (index + 1) * SECOND // 10
        orientation = Rotation.from_rotvec([0, 0, 2.0]).as_quat().tolist()
        estimator.add_odometry("r", stamp, orientation, (500.0 + 0.01 * index, 0.0, 0.0))
    frame = frame_of(estimator)
    assert math.dist(frame.place((500.0, 0.0, 0.0)), was) < 0.05
    assert (Rotation.from_quat(estimator.current_orientation("r")).inv() * turned).magnitude() < 1e-6
    assert math.isnan(frame.drift.position)  # since when, nobody knows


def test_each_robot_has_its_own():
    runs, estimator = {"a": drive(seed=1), "b": drive(seed=2)}, OnlineEstimator(OPTIONS)
    for robot, run in runs.items():
        run.feed(estimator, robot=robot)
        for index in range(LAP, run.length, 4):
            run.close(estimator, index, robot)
    paths = estimator.place(answered(estimator))
    for robot, run in runs.items():
        newest = run.stamps.index(int(paths[robot].stamp_ns[-1]))
        at = frame_of(estimator, robot).place(tuple(run.odometry_position[newest]))
        np.testing.assert_allclose(at, paths[robot].position[-1], atol=1e-9)


def test_nobody_is_placed_by_what_was_forgotten_nor_after_a_load_until_there_is_an_answer(tmp_path: Path):
    run, estimator = drive(), OnlineEstimator(OPTIONS)
    run.feed(estimator)
    for index in range(LAP, run.length, 4):
        run.close(estimator, index)
    answer = answered(estimator)
    estimator.place(answer)
    placed = frame_of(estimator)
    estimator.save(tmp_path / "state")
    estimator.reset()
    estimator.place(answer)
    assert estimator.odometry_frame("r") is None
    estimator.load(tmp_path / "state")
    assert estimator.odometry_frame("r") is None
    cold = estimator.tick(force_cold=True)
    assert cold is not None
    estimator.place(cold)
    again = frame_of(estimator)
    np.testing.assert_allclose(again.origin, placed.origin, atol=1e-6)
    np.testing.assert_allclose(again.orientation, placed.orientation, atol=1e-8)


def test_variances_grow_while_a_front_end_is_silent_but_not_while_the_robot_stands():
    """Keyframes come from a front end: odometry's steps since the last of them count all the same."""
    every, options = 5, replace(OPTIONS, keyframe_source="edges")
    run, estimator = drive(), OnlineEstimator(options)

    def keyframe(number: int) -> None:
        ends = (number - every, number)
        source, target = (KeyframeReference("r", end, run.stamps[end]) for end in ends)
        turn = (run.odometry[ends[0]].inv() * run.odometry[number]).as_quat().tolist()
        way = run.odometry[ends[0]].inv().apply(run.odometry_position[number] - run.odometry_position[ends[0]])
        edge = EdgeMeasurement.from_ros(number, source, target, turn, way.tolist())
        assert estimator.add_edge(replace(edge, kind=0)) is None

    def deviation() -> float:
        frame, steps = estimator.odometry_frame("r")
        return math.sqrt(frame.drift.after(steps, 0.0)[0])

    for number in range(0, LAP + 1, every):
        run.feed(estimator, number, number + every)
        if number:
            keyframe(number)
    estimator.place(answered(estimator))
    frame, steps = estimator.odometry_frame("r")
    assert steps == 1
    begun = deviation()
    run.feed(estimator, LAP + every, 2 * LAP)
    _, steps = estimator.odometry_frame("r")
    assert steps == pytest.approx(LAP / every, abs=2)
    expected = math.sqrt(begun**2 + (steps - 1) * frame.drift.step_orientation)
    assert deviation() == pytest.approx(expected) and expected > 1.1 * begun
    last, stands = 2 * LAP - 1, steps
    for tenths in range(1, 100):
        pose = run.odometry[last].as_quat().tolist(), run.odometry_position[last].tolist()
        assert estimator.add_odometry("r", run.stamps[last] + tenths * SECOND // 10, *pose) is None
    assert estimator.odometry_frame("r")[1] == stands
    # Half a lap later all steps of that lap turn the robot about where they were made: √2 radii away on average.
    across = run.odometry_position[last - LAP // 2]
    levers = [float(((each - across) ** 2).sum()) for each in run.odometry_position[LAP + every : 2 * LAP : every]]
    assert frame.steps.square_lever(tuple(across)) == pytest.approx(np.mean(levers), rel=0.1)
    turns_alone = replace(frame, drift=Drift(0.0, 0.0, 1e-4, 0.0))
    _, position = turns_alone.variances_at(tuple(run.odometry_position[last]), steps)
    assert position == pytest.approx(steps * 1e-4 * 2 * 4.0**2, rel=0.2)  # though the robot is back where it began
    estimator.set_options(replace(options, outlier_threshold=0.4))
    estimator.place(answered(estimator))  # with the same keyframes
    assert estimator.odometry_frame("r")[1] == stands
