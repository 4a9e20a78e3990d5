"""A pose graph of an odometry with closures from the ground truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.simulation.visual_odometry import odometry_graph
from rotavg_ros.metrics import true_edge_noise

LAP, FRAMES = 150, 400


def write_poses(path: Path, rotation: Rotation, position: np.ndarray) -> Path:
    rows = np.concatenate((rotation.as_matrix(), position[:, :, None]), axis=2).reshape(-1, 12)
    np.savetxt(path, rows)
    return path


def laps() -> tuple[Rotation, np.ndarray]:
    """Circles of 20 m radius, looking ahead."""
    angle = 2 * np.pi * np.arange(FRAMES) / LAP
    position = 20 * np.stack((np.cos(angle), np.zeros(FRAMES), np.sin(angle)), axis=1)
    return Rotation.from_rotvec(np.stack((np.zeros(FRAMES), -angle, np.zeros(FRAMES)), axis=1)), position


def test_the_graph_fits_its_truth(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rotation, position = laps()
    drift = Rotation.from_rotvec(np.radians(0.2) * rng.normal(size=(FRAMES, 3)).cumsum(axis=0))
    predicted = write_poses(tmp_path / "pred.txt", rotation * drift, position)
    truth = write_poses(tmp_path / "gt.txt", rotation, position)
    graph_file = odometry_graph(predicted, truth, rng, closure_noise_deg=1.0)
    graph = graph_file.graph
    is_odometry = graph.is_odometry
    assert int(is_odometry.sum()) == FRAMES - 1
    closures = graph.select_edges(~is_odometry)
    assert (closures.target - closures.source >= 100).all()
    # Every fifth frame of the later laps, and what the circle's 5 m before its end see of its start.
    assert len(range(LAP, FRAMES, 5)) <= closures.num_edges <= len(range(LAP - 6, FRAMES, 5))
    noise = true_edge_noise(graph, torch.from_numpy(graph_file.body_from_world_gt))
    assert float(torch.rad2deg(noise[~is_odometry]).max()) < 6
    for kind in (is_odometry, ~is_odometry):  # what is stated is what there is
        per_component = float((noise[kind] ** 2).mean() / 3)
        assert per_component * float(graph.precision[kind][0]) == pytest.approx(1, abs=0.3)


def test_files_of_different_length(tmp_path: Path) -> None:
    rotation, position = laps()
    predicted = write_poses(tmp_path / "pred.txt", rotation, position)
    truth = write_poses(tmp_path / "gt.txt", rotation[:-1], position[:-1])
    with pytest.raises(GraphFileError, match="must be of the same frames"):
        odometry_graph(predicted, truth, np.random.default_rng(0))
