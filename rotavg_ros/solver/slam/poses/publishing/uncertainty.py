"""Variances of all nodes' poses, relative to the first node of their component.

The system holds each component at its root, an end of odometry, so that numbers of keyframes change nothing. Seen from
the first node f, with ℓ = p − p_f, a node's turn errs by δ − δ_f and its position by ε − ε_f + δ_f × ℓ. What that takes
besides is the covariance of all nodes with f, one column of H⁻¹ for each of its d unknowns; components have none in
common, so they are solved at once.
"""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.poses.publishing.inner_nodes import InnerNodes, NodePoses
from rotavg_ros.solver.slam.poses.rows import crossed, loose_weight
from rotavg_ros.solver.slam.poses.solved import PoseMode


def variances(pose: PoseMode, nodes: NodePoses) -> tuple[np.ndarray, np.ndarray]:
    """``(N,)`` rad² and m² per component, of orientations and positions."""
    drawn, k = pose.problem.drawn, pose.problem.turns
    inner = InnerNodes.of(pose, nodes)
    square = pose.solved.factor.variance[: drawn.num_nodes][drawn.above]
    square[inner.node] = np.diagonal(inner.covariance(pose), axis1=1, axis2=2)
    if not drawn.is_held_at_first:
        square = np.maximum(square + _seen_from_first(pose, nodes, inner), 0.0)
    turn, shift = square[:, :k].mean(axis=1), square[:, k:].mean(axis=1)
    # The solve has no prior of where a chain lies that closures alone join to a root: if they tell nothing, it is this.
    unknown = 1 / loose_weight(pose.problem, pose.solved.scale.extent)
    is_loose = ~np.isin(drawn.chain, drawn.chain[drawn.roots])[drawn.above]
    return (
        np.where(is_loose, turn * unknown[0] / (turn + unknown[0]), turn),
        np.where(is_loose, shift * unknown[-1] / (shift + unknown[-1]), shift),
    )


def _seen_from_first(pose: PoseMode, nodes: NodePoses, inner: InnerNodes) -> np.ndarray:
    """``(N, d)`` by how much variances relative to the first nodes exceed those relative to the roots."""
    problem, first = pose.problem, pose.problem.drawn.first
    k, d = problem.turns, problem.turns + problem.shifts
    common = _with_first(pose, nodes, inner)
    seen = np.zeros((len(first), d, d))
    seen[:, :k, :k], seen[:, k:, k:] = -np.eye(k), -np.eye(problem.shifts)
    seen[:, k:, :k] = -crossed(problem, nodes.position - nodes.position[first])
    turned = seen.transpose(0, 2, 1)
    more = seen @ common[first] @ turned + 2 * common @ turned
    return np.asarray(np.diagonal(more, axis1=1, axis2=2))


def _with_first(pose: PoseMode, nodes: NodePoses, inner: InnerNodes) -> np.ndarray:
    """``(N, d, d)`` covariance of each node's turn and position with those of its first node."""
    problem, drawn = pose.problem, pose.problem.drawn
    d, first = problem.turns + problem.shifts, np.unique(drawn.first)
    source, target = drawn.source[inner.segment], drawn.target[inner.segment]
    number = np.full(len(drawn.first), -1)
    number[inner.node] = np.arange(len(inner.node))
    columns = np.zeros((problem.equations.num_blocks, d, d))
    key = first[number[first] < 0]
    columns[drawn.above[key]] += np.eye(d)
    for some in number[first[number[first] >= 0]]:
        columns[target[some]] += inner.jacobian[some, :, :d].T
        columns[source[some]] += inner.jacobian[some, :, d : 2 * d].T
    factor = pose.solved.factor
    of_key = factor.ended(factor.begun(columns))
    common = np.asarray(of_key[drawn.above])
    at_target, at_source = inner.jacobian[:, :, :d], inner.jacobian[:, :, d : 2 * d]
    common[inner.node] = at_target @ of_key[target] + at_source @ of_key[source]
    of_first = number[drawn.first[inner.node]]
    beside = np.flatnonzero((of_first >= 0) & (inner.segment[of_first] == inner.segment))
    common[inner.node[beside]] += inner.left_with(pose, nodes.way, beside, of_first[beside])
    return common
