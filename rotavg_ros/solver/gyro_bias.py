"""A constant bias of the odometry's gyroscope, estimated from loop closures that disagree with it.

A bias β turns every step of the odometry a little further, ``M̃ = M exp(β)`` with β in the body's frame. Along a chain
the errors ``R_k⁻¹ β`` add up in the world's frame to a rotation vector that is linear in β, so a closure's residual
with the odometry is too, as long as it is small. Every closure alone proposes a bias; the one that most closures agree
to is refined by expectation–maximisation, taken out of the odometry, and estimated again about the better chain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.noise_model import NoiseModel
from rotavg_ros.solver.spanning_tree import SpanningForest, accumulate_to_root
from rotavg_ros.view_graph import ViewGraph

# Proposals come from so many closures, those that span the least odometry first: their angles have not wrapped around.
_MAX_PROPOSALS = 60
_EM_ITERATIONS = 10
# Prior standard deviation of a component of the bias, rad per step.
_PRIOR_BIAS = np.radians(1.0)


def estimate_bias(
    graph: ViewGraph, forest: SpanningForest, closure_graph: ClosureGraph, noise: NoiseModel
) -> np.ndarray:
    """Bias ``(3,)`` rad per step that the closures speak of; zeros where none can be told.

    Args:
        graph: the view-graph.
        forest: along which ``closure_graph`` was contracted.
        noise: of steps and closures without the bias.
    """
    closure = np.flatnonzero(closure_graph.is_closure & np.isfinite(closure_graph.path_steps))
    if len(closure) == 0:
        return np.zeros(3)
    nodes = closure_graph.nodes
    drift = _drift_per_bias(graph, forest, closure_graph)
    ends = nodes[closure_graph.source[closure]], nodes[closure_graph.target[closure]]
    design = drift[ends[0]] - drift[ends[1]]
    measured = closure_graph.residual[torch.from_numpy(closure)]
    steps = np.maximum(closure_graph.path_steps[closure], 1.0)
    variance = steps * noise.step_variance + noise.closure_variance

    def remainder(bias: np.ndarray) -> np.ndarray:
        predicted = rotations.exp(torch.from_numpy(-design @ bias))
        return np.asarray(rotations.log(rotations.multiply(predicted, measured)).numpy())

    def log_odds(rest: np.ndarray) -> np.ndarray:
        return noise.inlier_log_odds((rest**2).sum(axis=1), variance) + noise.prior_log_odds

    def solve(weight: np.ndarray, rest: np.ndarray, about: np.ndarray) -> np.ndarray:
        weighted = design * (weight / variance)[:, None, None]
        normal = np.einsum("cij,cik->jk", weighted, design) + np.eye(3) / _PRIOR_BIAS**2
        gradient = np.einsum("cij,ci->j", weighted, rest) - about / _PRIOR_BIAS**2
        return np.asarray(np.linalg.solve(normal, gradient))

    residual = remainder(np.zeros(3))
    proposals = [np.zeros(3)]
    for number in np.argsort(steps, kind="stable")[:_MAX_PROPOSALS]:
        proposals.append(solve((np.arange(len(closure)) == number).astype(np.float64), residual, np.zeros(3)))
    support = [float(np.logaddexp(0, log_odds(remainder(bias))).sum()) for bias in proposals]
    bias = proposals[int(np.argmax(support))]
    for _ in range(_EM_ITERATIONS):
        rest = remainder(bias)
        weight = 1 / (1 + np.exp(np.clip(-log_odds(rest), -50, 50)))
        bias = bias + solve(weight, rest, bias)
    return np.asarray(bias)


def without_bias(graph: ViewGraph, bias: np.ndarray) -> ViewGraph:
    """The graph with ``bias`` ``(3,)`` rad per step taken out of its odometry, whichever way an edge runs.

    An edge of several steps is taken for one about the same axis throughout.
    """
    turn = rotations.exp(-graph.steps[:, None] * torch.from_numpy(bias))
    measured = graph.target_from_source
    forwards = rotations.multiply(measured, turn)
    backwards = rotations.multiply(rotations.inverse(turn), measured)
    corrected = torch.where((graph.source < graph.target)[:, None], forwards, backwards)
    corrected = torch.where(graph.is_odometry[:, None], corrected, measured)
    return replace(graph, target_from_source=rotations.canonical(rotations.normalize(corrected)))


def _drift_per_bias(graph: ViewGraph, forest: SpanningForest, closure_graph: ClosureGraph) -> np.ndarray:
    """``(N, 3, 3)``: world-frame rotation vector of each node's odometry error per bias, from its root on."""
    child = np.flatnonzero(forest.parent_edge >= 0)
    edge = forest.parent_edge[child]
    source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
    # A step turns about the body of its earlier node; forwards along the tree or backwards.
    earlier = np.minimum(source, target)
    steps = (graph.steps * graph.is_odometry).numpy()[edge]
    sign = np.where(earlier == child, -1.0, 1.0) * steps
    world_from_body = rotations.to_matrix(rotations.inverse(closure_graph.odometry_orientation)).numpy()
    step = np.zeros((graph.num_nodes, 9))
    step[child] = (sign[:, None, None] * world_from_body[earlier]).reshape(-1, 9)
    return np.stack([accumulate_to_root(forest, column) for column in step.T], axis=1).reshape(-1, 3, 3)
