"""Places that look alike and are mistaken again and again: by the same shift, with the right heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.metrics.positions import position_errors

# Metres between aisles, keyframes along each, and how many there are.
_SPACING, _LENGTH, _AISLES = 4.0, 30, 6


@dataclass(frozen=True)
class Warehouse:
    """Aisles that are driven there and back (N keyframes, C closures last of all edges).

    Attributes:
        graph: odometry of .3° and 2 cm a metre; scans matched to .1° and 2 cm.
        position: ``(N, 3)`` true metres.
        is_false: ``(C,)`` bool, the closures that take an aisle for the one after the next.
    """

    graph: ViewGraph
    position: FloatArray
    is_false: np.ndarray


def _yaw(angle: FloatArray) -> Rotation:
    return Rotation.from_rotvec(angle[:, None] * np.array([0.0, 0.0, 1.0]))


def warehouse(seed: int, good: int, false: int) -> Warehouse:
    rng = np.random.default_rng(seed)
    along, aisle = (each.ravel() for each in np.meshgrid(np.arange(float(_LENGTH)), np.arange(_AISLES)))
    there = np.stack((np.where(aisle % 2 == 0, along, _LENGTH - 1 - along), _SPACING * aisle), axis=1)
    position = np.concatenate((there, there[::-1]))
    heading = np.where(aisle % 2 == 0, 0.0, np.pi)
    heading = np.concatenate((heading, heading[::-1] + np.pi))
    count, half = len(position), len(there)
    older = rng.permutation(half)[: good + false]
    is_false = np.arange(len(older)) < false
    farther = 2 * _LENGTH * np.where(older < half - 2 * _LENGTH, 1, -1)
    newer = count - 1 - (older + is_false * farther)
    source, target = np.append(np.arange(count - 1), older), np.append(np.arange(1, count), newer)
    is_closure = np.arange(len(source)) >= count - 1
    # Whoever is at a place sees it as it is, or as the one that it is taken for.
    world = np.where(is_closure[:, None], 0.0, position[target] - position[source])
    body = _yaw(-heading[source]).apply(np.pad(world, ((0, 0), (0, 1))))
    body[:, :2] += rng.normal(0, 0.02, world.shape)
    # The turn from source to target, as the target's frame sees the source's.
    turn = heading[source] - heading[target] + np.radians(np.where(is_closure, 0.1, 0.3)) * rng.normal(size=len(source))
    graph = ViewGraph.create(
        source,
        target,
        torch.from_numpy(_yaw(turn).as_quat()),
        num_nodes=count,
        kind=is_closure.astype(np.int64),
        translation=torch.from_numpy(body),
    )
    return Warehouse(graph, np.pad(position, ((0, 0), (0, 1))), is_false)


@pytest.mark.parametrize(("good", "false", "seed"), [(40, 30, 6), (40, 30, 10), (25, 15, 2)])
def test_aisles_that_are_mistaken_for_each_other_are_no_jump(good: int, false: int, seed: int) -> None:
    """Odometry that jumps by two aisles, there and back, explains them too, where a step is as long as one aisle."""
    run = warehouse(seed, good, false)
    solution = solve(run.graph)
    is_closure = ~run.graph.is_odometry
    np.testing.assert_array_equal((solution.outlier_score > 0.5)[is_closure].numpy(), run.is_false)
    assert float(solution.outlier_score[~is_closure].max()) < 0.5
    assert solution.position is not None
    off = position_errors(solution.position.numpy(), run.position)
    assert np.sqrt((off**2).mean()) < 0.6
