"""Labels that follow a graph's edges."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import ViewGraph
from rotavg_ros.solver.slam.update.grown_edges import thinned_out
from rotavg_ros.view_graph import EdgeKind

TURNS = ((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.6, 0.8))


def graph_of(num_nodes: int, closures: list[tuple[int, int, int]]) -> ViewGraph:
    """A chain and closures, each by its ends and the number of its turn."""
    chain = [(node, node + 1, 0) for node in range(num_nodes - 1)]
    source, target, turn = np.array(chain + closures).T
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [len(chain), len(closures)])
    return ViewGraph.create(source, target, np.array(TURNS)[turn], kind=kind)


def test_closures_of_one_rotation_keep_their_own_labels_when_keyframes_go() -> None:
    """In the plane many state no turn at all; each had got the label of the first."""
    before = graph_of(9, [(0, 4, 0), (2, 6, 1), (0, 7, 0), (2, 8, 0)])
    value = np.append(np.ones(8), [1.0, 0.0, 0.0, 1.0])
    after = graph_of(7, [(0, 3, 0), (1, 4, 1), (0, 5, 0), (1, 6, 0)])
    found = thinned_out(value, before, after, 2.0)
    assert found is not None
    np.testing.assert_array_equal(found, np.append(np.ones(6), [1.0, 0.0, 0.0, 1.0]))


def test_where_one_of_several_has_gone_only_equal_labels_are_known() -> None:
    before = graph_of(9, [(0, 4, 0), (2, 6, 1), (0, 7, 0), (2, 8, 0), (1, 6, 1)])
    value = np.append(np.ones(8), [1.0, 0.0, 0.0, 1.0, 0.0])
    after = graph_of(7, [(0, 3, 0), (1, 4, 1), (0, 5, 0), (0, 6, 1), (1, 5, 1)])
    found = thinned_out(value, before, after, 2.0)
    assert found is not None
    np.testing.assert_array_equal(found[torch.nonzero(~after.is_odometry)[:, 0].numpy()], [2.0, 0.0, 2.0, 0.0, 0.0])
