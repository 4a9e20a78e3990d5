"""Pose graphs of a visual odometry with loop closures made from the ground truth, e.g. for KITTI's sequences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError
from rotavg_ros.datasets.files.kitti import read_poses
from rotavg_ros.view_graph import EdgeKind

# A place counts as seen again within this distance and angle and after this many frames; it is checked this often.
_REVISIT_METRES = 5.0
_REVISIT_ANGLE = np.radians(45.0)
_REVISIT_FRAMES = 100
_FRAMES_PER_CLOSURE = 5


def odometry_graph(
    predicted: str | Path, truth: str | Path, rng: np.random.Generator, closure_noise_deg: float = 1.0
) -> GraphFile:
    """An odometry's steps, and true loop closures with noise where the ground truth revisits a place.

    Odometry states the precision that its steps have against the ground truth, closures that of their noise.

    Args:
        predicted, truth: pose files of the same frames.
        closure_noise_deg: standard deviation of each component of the closures' noise.

    Raises:
        GraphFileError: a malformed file, or files of different length.
    """
    world_from_camera, _ = read_poses(predicted)
    true_world_from_camera, position = read_poses(truth)
    frames = len(world_from_camera)
    if len(true_world_from_camera) != frames:
        what = f"{len(true_world_from_camera)} poses, but {predicted} has {frames}; they must be of the same frames"
        raise GraphFileError.at(truth, None, what)
    step = world_from_camera[1:].inv() * world_from_camera[:-1]
    true_step = true_world_from_camera[1:].inv() * true_world_from_camera[:-1]
    step_variance = float(((step * true_step.inv()).as_rotvec() ** 2).mean())

    source, target = _revisits(true_world_from_camera, position)
    noise = np.radians(closure_noise_deg)
    error = Rotation.from_rotvec(rng.normal(scale=noise, size=(len(source), 3)))
    closure = error * true_world_from_camera[target].inv() * true_world_from_camera[source]
    graph_file = GraphFile.from_ids(
        np.concatenate((np.arange(frames - 1), source)),
        np.concatenate((np.arange(1, frames), target)),
        np.concatenate((step.as_quat(), closure.as_quat())),
        kind=np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], (frames - 1, len(source))),
        precision=np.repeat([1 / step_variance, 1 / noise**2], (frames - 1, len(source))),
    )
    truth_quaternions = true_world_from_camera.inv().as_quat(canonical=True)
    return replace(graph_file, body_from_world_gt=truth_quaternions, position_gt=position)


def _revisits(world_from_camera: Rotation, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(C,)`` earlier and later frames that see the same place; the nearest of several earlier ones."""
    tree = cKDTree(position)
    pairs = []
    for later in range(0, len(position), _FRAMES_PER_CLOSURE):
        near = np.array(tree.query_ball_point(position[later], _REVISIT_METRES), dtype=np.int64)
        near = near[near <= later - _REVISIT_FRAMES]
        if len(near):
            turned = (world_from_camera[near].inv() * world_from_camera[later]).magnitude()
            near = near[turned < _REVISIT_ANGLE]
        if len(near):
            distance = np.linalg.norm(position[near] - position[later], axis=1)
            pairs.append((int(near[distance.argmin()]), later))
    earlier, later_frames = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return earlier, later_frames
