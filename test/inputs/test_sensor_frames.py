"""Edges between sensors and between bodies, beside 4 × 4 matrices; trees of transforms as robots have, and rings."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs.sensor_frames import Mounting, SensorFrames
from rotavg_ros.online import EdgeMeasurement, KeyframeReference

QUARTER_ABOUT_Z = Rotation.from_euler("z", 90, degrees=True)
QUARTER_ABOUT_X = Rotation.from_euler("x", 90, degrees=True)


def matrix(rotation: Rotation, position) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def matrix_of(mounting: Mounting) -> np.ndarray:
    return matrix(Rotation.from_quat(mounting.orientation), mounting.position)


def transform(parent: str, child: str, pose: np.ndarray) -> Fields:
    qx, qy, qz, qw = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    x, y, z = pose[:3, 3].tolist()
    rotation, translation = Fields(x=qx, y=qy, z=qz, w=qw), Fields(x=x, y=y, z=z)
    return Fields(
        header=Fields(frame_id=parent),
        child_frame_id=child,
        transform=Fields(rotation=rotation, translation=translation),
    )


def message(*transforms: Fields) -> Fields:
    return Fields(transforms=list(transforms))


def any_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return matrix(Rotation.random(random_state=rng), rng.normal(size=3))


def edge(source_from_target: np.ndarray, with_translation: bool = True) -> EdgeMeasurement:
    ends = KeyframeReference("a", 1), KeyframeReference("a", 2)
    rotation = Rotation.from_matrix(source_from_target[:3, :3])
    translation = tuple(source_from_target[:3, 3].tolist()) if with_translation else None
    return EdgeMeasurement.from_ros(7, *ends, rotation.as_quat().tolist(), translation, precision=3.0)


def pose_of(found: EdgeMeasurement) -> np.ndarray:
    return matrix(Rotation.from_quat(found.target_from_source).inv(), found.translation)


@pytest.mark.parametrize("turned", [QUARTER_ABOUT_Z, QUARTER_ABOUT_X, QUARTER_ABOUT_Z * QUARTER_ABOUT_X])
def test_an_edge_of_a_camera_is_the_edge_of_the_body(turned: Rotation) -> None:
    """The body drives from one pose to another; what the camera sees of that is taken back."""
    body_from_camera = matrix(turned, [0.3, -0.1, 1.2])
    frames = SensorFrames()
    frames.take(message(transform("base_link", "camera", body_from_camera)))
    frames.note_body("a", "base_link")
    mounting = frames.body_from("a", "camera")
    assert mounting is not None
    start, end = any_pose(1), any_pose(2)
    of_body = np.linalg.inv(start) @ end
    of_camera = np.linalg.inv(start @ body_from_camera) @ (end @ body_from_camera)
    found = mounting.edge_of_body(edge(of_camera))
    np.testing.assert_allclose(pose_of(found), of_body, atol=1e-12)
    assert (found.edge_id, found.precision, found.source.keyframe_id) == (7, 3.0, 1)
    without = mounting.edge_of_body(edge(of_camera, with_translation=False))
    assert without.translation is None and without.target_from_source == found.target_from_source


def test_transforms_are_chained_up_and_down_the_tree() -> None:
    """base_footprint → base_link → mast → camera, and the odometry moves in imu, which hangs below base_link."""
    footprint_from_base, base_from_mast, mast_from_camera, base_from_imu = map(any_pose, range(4))
    frames = SensorFrames()
    frames.note_body("a", "imu")
    frames.take(message(transform("mast", "camera", mast_from_camera), transform("base_link", "mast", any_pose(9))))
    assert frames.body_from("a", "camera") is None
    frames.take(
        message(
            transform("base_link", "imu", base_from_imu),
            transform("/base_footprint", "/base_link", footprint_from_base),
            transform("base_link", "mast", base_from_mast),
        )
    )
    mounting = frames.body_from("a", "camera")
    assert mounting is not None
    expected = np.linalg.inv(base_from_imu) @ base_from_mast @ mast_from_camera
    np.testing.assert_allclose(matrix_of(mounting), expected, atol=1e-12)
    up = frames.body_from("a", "base_footprint")
    assert up is not None
    expected = np.linalg.inv(footprint_from_base @ base_from_imu)
    np.testing.assert_allclose(matrix_of(up), expected, atol=1e-12)
    assert frames.body_from("a", "/camera") == mounting
    assert frames.body_from("a", "elsewhere") is None and frames.body_from("b", "camera") is None


def between(source: str, target: str, translation: tuple[float, float, float] | None = None) -> EdgeMeasurement:
    ends = KeyframeReference(source, 1), KeyframeReference(target, 1)
    return EdgeMeasurement.from_ros(7, *ends, (0.0, 0.0, 0.0, 1.0), translation)


@pytest.mark.parametrize(
    ("bodies", "camera"),
    [(("a/base_link", "b/base_link"), "a/camera"), (("base_link", "imu"), "camera")],
    ids=["frames of each robot", "frames of one name"],
)
def test_a_sensor_that_is_mounted_differently_on_two_robots_is_told_of(bodies: tuple[str, str], camera: str) -> None:
    forward, turned = matrix(Rotation.identity(), [0.3, 0.0, 0.0]), matrix(QUARTER_ABOUT_Z, [0.3, 0.0, 0.0])
    frames = SensorFrames()
    for robot, body in zip("ab", bodies, strict=True):
        frames.note_body(robot, body)
    frames.take(message(transform(bodies[0], camera, forward)))
    assert frames.unlike(between("a", "b"), camera) is None  # nobody knows yet
    if bodies[1] == "imu":
        frames.take(message(transform("base_link", "imu", turned)))
    else:
        frames.take(message(transform("b/base_link", "b/camera", turned)))
    told = frames.unlike(between("a", "b"), camera)
    assert told is not None and f"{camera} is mounted differently on a and on b" in told
    assert frames.unlike(between("a", "a"), camera) is None and frames.unlike(between("a", "c"), camera) is None


def test_a_lever_arm_counts_where_translations_are_told() -> None:
    frames = SensorFrames()
    for robot, height in (("a", 0.3), ("b", 1.1)):
        frames.note_body(robot, f"{robot}/base")
        frames.take(message(transform(f"{robot}/base", f"{robot}/lidar", matrix(Rotation.identity(), [0, 0, height]))))
    assert frames.unlike(between("a", "b"), "a/lidar") is None
    assert frames.unlike(between("a", "b", (1.0, 0.0, 0.0)), "a/lidar") is not None
    assert frames.unlike(between("a", "b", (1.0, 0.0, 0.0)), "a/base") is None


def test_an_edge_of_the_body_is_left_as_it_is() -> None:
    frames = SensorFrames()
    frames.note_body("a", "")
    assert frames.body_from("a", "base_link") is None
    frames.note_body("a", "base_link")
    mounting = frames.body_from("a", "base_link")
    measured = edge(any_pose(3))
    assert mounting is not None and mounting.edge_of_body(measured) is measured


def test_odometry_of_a_sensor_that_is_turned_in_the_body() -> None:
    """odometry_sensor_orientations says how the odometry's frame is turned; the tree leads there."""
    imu_from_camera, body_from_imu = any_pose(4), QUARTER_ABOUT_X
    frames = SensorFrames()
    frames.take(message(transform("imu", "camera", imu_from_camera)))
    frames.note_body("a", "imu", tuple(body_from_imu.as_quat().tolist()))
    mounting = frames.body_from("a", "camera")
    assert mounting is not None
    expected = matrix(body_from_imu, np.zeros(3)) @ imu_from_camera
    np.testing.assert_allclose(matrix_of(mounting), expected, atol=1e-12)


def test_nonsense_is_left_out() -> None:
    frames = SensorFrames()
    frames.note_body("a", "base_link")
    ring = message(transform("x", "y", any_pose(1)), transform("y", "z", any_pose(2)), transform("z", "x", any_pose(3)))
    frames.take(ring)
    frames.take(message(transform("y", "y", any_pose(1))))
    assert frames.body_from("a", "y") is None
    good = transform("base_link", "camera", any_pose(5))
    frames.take(message(good))
    known = frames.body_from("a", "camera")
    bad = [transform("base_link", "camera", any_pose(6)) for _ in range(3)]
    bad[0].transform.rotation.w = float("nan")
    bad[1].transform.translation.x = float("inf")
    bad[2].transform.rotation = Fields(x=0.0, y=0.0, z=0.0, w=0.0)
    frames.take(message(*bad))
    assert known is not None and frames.body_from("a", "camera") == known
    frames.take(message(transform("base_link", "camera", any_pose(7))))
    assert frames.body_from("a", "camera") != known


def test_what_is_remembered_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rotavg_ros.inputs.sensor_frames._MOST_FRAMES", 10)
    frames = SensorFrames()
    frames.note_body("a", "base_link")
    frames.take(message(*(transform("base_link", f"frame{number}", any_pose(number)) for number in range(100))))
    assert frames.body_from("a", "frame9") is not None and frames.body_from("a", "frame10") is None
    for number in range(1000):
        frames.body_from("a", f"nonsense{number}")
    assert len(frames._found) <= 10
