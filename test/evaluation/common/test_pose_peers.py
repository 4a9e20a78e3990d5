"""GTSAM's methods on poses get them the right way round: without noise they agree with the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.evaluation.common import peers
from rotavg_ros.metrics import orientation_errors, position_errors
from rotavg_ros.view_graph import ViewGraph

NUM_NODES = 12


def pose_graph(planar: bool, outlier: bool = False) -> tuple[ViewGraph, torch.Tensor, np.ndarray]:
    """A chain and closures in both directions, the last one false on request: right rotation, wrong place."""
    rng = np.random.default_rng(0)
    turn = Rotation.from_rotvec(rng.normal(size=(NUM_NODES, 3)) * ([0, 0, 1] if planar else [1, 1, 1]))
    position = np.cumsum(rng.normal(size=(NUM_NODES, 3)) * [1, 1, not planar], axis=0)
    source = np.array([*range(NUM_NODES - 1), 0, 9, 3, 11, 1])
    target = np.array([*range(1, NUM_NODES), 4, 2, 8, 0, 7])
    translation = turn[source].inv().apply(position[target] - position[source])
    translation[-1, :2] += 10.0 * outlier
    graph = ViewGraph.create(
        source,
        target,
        (turn[target].inv() * turn[source]).as_quat(canonical=True),
        kind=[0] * (NUM_NODES - 1) + [1] * 5,
        translation=translation,
    )
    return graph, torch.from_numpy(turn.inv().as_quat()), position


def along_odometry(graph: ViewGraph) -> tuple[np.ndarray, np.ndarray]:
    assert graph.translation is not None
    return chain_poses(graph, graph.translation.numpy())


SIGMA = np.tile([0.01, 0.05], (NUM_NODES + 4, 1))


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("peer", [peers.gnc_on_poses, peers.isam2_on_poses])
def test_noise_free(peer: object, planar: bool) -> None:
    pytest.importorskip("gtsam")
    graph, orientations, position = pose_graph(planar)
    answer = peer(graph, SIGMA, along_odometry(graph))  # type: ignore[operator]
    assert float(orientation_errors(answer.body_from_world, orientations).max()) < 1e-5
    assert position_errors(answer.position.numpy(), position).max() < 1e-5
    assert answer.seconds > 0


@pytest.mark.parametrize("planar", [True, False])
def test_the_closure_that_joins_a_wrong_place_is_found(planar: bool) -> None:
    pytest.importorskip("gtsam")
    graph, _, position = pose_graph(planar, outlier=True)
    answer = peers.gnc_on_poses(graph, SIGMA, along_odometry(graph))
    assert answer.outlier_score is not None and answer.position is not None
    assert (answer.outlier_score > 0.5).nonzero().flatten().tolist() == [graph.num_edges - 1]
    # Where the annealing ends, something of an outlier's weight is left.
    assert position_errors(answer.position.numpy(), position).max() < 1e-3
    robust = peers.isam2_on_poses(graph, SIGMA, along_odometry(graph))
    assert robust.position is not None
    assert position_errors(robust.position.numpy(), position).max() < 0.5


def test_deviations_count() -> None:
    """Of two closures that contradict each other the one of the smaller deviation is believed."""
    pytest.importorskip("gtsam")
    graph, _, _ = pose_graph(planar=True)
    assert graph.translation is not None
    translation = graph.translation.clone()
    translation[-1, 0] += 0.2
    sigma = SIGMA.copy()
    sigma[:, 1] = 10.0
    sigma[-1] = 1e-3
    graph = replace(graph, translation=translation)
    answer = peers.gnc_on_poses(graph, sigma, along_odometry(graph))
    assert answer.position is not None
    frame = Rotation.from_quat(answer.body_from_world.numpy())[1]
    shift = frame.apply(answer.position[7].numpy() - answer.position[1].numpy())
    np.testing.assert_allclose(shift, translation[-1].numpy(), atol=1e-2)
