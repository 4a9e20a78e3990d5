"""Small graphs with known truth for the solver's tests."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import EdgeKind, ViewGraph


def random_truth(num_nodes: int, seed: int, planar: bool = False) -> Rotation:
    """body_from_world."""
    if planar:
        yaw = np.random.default_rng(seed).uniform(-np.pi, np.pi, num_nodes)
        return Rotation.from_rotvec(yaw[:, None] * [0, 0, 1])
    return Rotation.random(num_nodes, random_state=seed)


def measured(
    truth: Rotation, source: np.ndarray, target: np.ndarray, noise: Rotation | None = None, **fields: object
) -> ViewGraph:
    """The graph that measures ``truth``, with right-multiplied noise."""
    relative = truth[target] * truth[source].inv()
    if noise is not None:
        relative = relative * noise
    return ViewGraph.create(source, target, relative.as_quat(), num_nodes=len(truth), **fields)  # type: ignore[arg-type]


def slam_edges(num_nodes: int, num_closures: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target and kind of an odometry chain with random closures, some of them new → old."""
    rng = np.random.default_rng(seed)
    start = rng.integers(0, num_nodes - 5, num_closures)
    end = np.minimum(start + rng.integers(3, num_nodes, num_closures), num_nodes - 1)
    turned = rng.random(num_closures) < 0.5
    source = np.concatenate((np.arange(num_nodes - 1), np.where(turned, end, start)))
    target = np.concatenate((np.arange(1, num_nodes), np.where(turned, start, end)))
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [num_nodes - 1, num_closures])
    return source, target, kind


def small_noise(count: int, sigma_deg: float | np.ndarray, seed: int, planar: bool = False) -> Rotation:
    """Gaussian rotation vectors, the same standard deviation in every component."""
    vectors = np.random.default_rng(seed).standard_normal((count, 3)) * np.radians(np.reshape(sigma_deg, (-1, 1)))
    return Rotation.from_rotvec(vectors * ([0, 0, 1] if planar else [1, 1, 1]))


def as_quaternions(rotation: Rotation) -> Tensor:
    return torch.from_numpy(rotation.as_quat(canonical=True))
