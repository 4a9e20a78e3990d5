"""A constant bias of the odometry's gyroscope, estimated from loop closures that disagree with it.

A bias β turns every step of the odometry a little further, ``M̃ = M exp(β)`` with β in the body's frame. Along a chain
the errors ``R_k⁻¹ β`` add up in the world's frame to a rotation vector that is linear in β. So a closure's residual
against the odometry is linear in β too, as long as it is small. The closures that span the least odometry propose a
bias each. The likeliest of these is refined by expectation–maximisation, removed from the odometry, and estimated again
for the better chain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import expit

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest, accumulate_to_root
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.graph.odometry_paths import beside_the_chain, runs_forward
from rotavg_ros.solver.slam.graph.routes import routes_of
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.view_graph import ViewGraph

# Number of closures that propose a bias: those that span the least odometry, since their angles do not wrap around.
_MAX_PROPOSALS = 60
# More closures than this do not improve an estimate of three numbers.
_MAX_CLOSURES = 1500
_EM_ITERATIONS = 10
# Prior standard deviation of a component of the bias, rad per step. The estimate is only where Newton steps of the
# posterior begin; F has a prior of its own.
_PRIOR_BIAS = np.radians(1.0)


class BiasEstimate(NamedTuple):
    """A bias of the odometry.

    Attributes:
        bias: ``(3,)`` rad per step.
        explained: share of the closures that are good with it, minus the share that are good without it.
    """

    bias: np.ndarray
    explained: float


def estimate_bias(
    graph: ViewGraph, forest: SpanningForest, closure_graph: ClosureGraph, noise: NoiseModel
) -> BiasEstimate:
    """The bias that the closures indicate; zeros if they determine none.

    Args:
        graph: the view-graph.
        forest: along which ``closure_graph`` was contracted.
        closure_graph: the contraction.
        noise: of steps and closures without the bias.
    """
    closure = np.flatnonzero(closure_graph.is_closure & np.isfinite(closure_graph.path_steps))
    closure = closure[:: max(1, len(closure) // _MAX_CLOSURES)]
    if len(closure) == 0:
        return BiasEstimate(np.zeros(3), 0.0)
    nodes = closure_graph.nodes
    drift = drift_per_bias(graph, forest, closure_graph)
    # From the older end on, whichever way it is stated: the residual is linear in the bias only to first order.
    is_forward = closure_graph.is_forward[closure, None]
    ends = nodes[closure_graph.source[closure]], nodes[closure_graph.target[closure]]
    design = np.where(is_forward, 1.0, -1.0)[:, :, None] * (drift[ends[0]] - drift[ends[1]])
    measured = closure_graph.residual.numpy()[closure]
    measured = np.where(is_forward, measured, measured * [-1, -1, -1, 1])
    measured_rows = np.ascontiguousarray(measured.T)
    steps = np.maximum(closure_graph.path_steps[closure], 1.0)
    variance = steps * noise.step_variance + noise.closure_variance
    highest = noise.prior_log_odds - noise.components / 2 * np.log(2 * np.pi * variance)

    def log_odds(squared_angle: np.ndarray) -> np.ndarray:
        uniform = log_uniform_density(np.sqrt(squared_angle).ravel(), noise.components)
        return np.asarray(highest - squared_angle / (2 * variance) - uniform.reshape(squared_angle.shape))

    proposed = np.argsort(steps, kind="stable")[:_MAX_PROPOSALS]
    residual = quaternion_rows.log(measured_rows).T
    inverse_variance = 1 / variance[proposed, None, None]
    normal = np.swapaxes(design[proposed], 1, 2) * inverse_variance
    proposals = np.linalg.solve(
        normal @ design[proposed] + np.eye(3) / _PRIOR_BIAS**2, normal @ residual[proposed, :, None]
    )[..., 0]
    proposals = np.concatenate((np.zeros((1, 3)), proposals))
    # Single precision is enough to choose among proposals.
    single = (array.astype(np.float32) for array in (design, measured, proposals))
    of_proposals = log_odds(_squared_angles(*single)).astype(np.float32)
    softplus = np.maximum(of_proposals, 0) + np.log(1 + np.exp(-np.abs(of_proposals)))
    bias = proposals[softplus.sum(axis=1, dtype=np.float64).argmax()]
    for _ in range(_EM_ITERATIONS):
        turned = quaternion_rows.multiply(quaternion_rows.exp(-(design @ bias).T), measured_rows)
        rest = np.ascontiguousarray(quaternion_rows.log(turned).T)
        weight = expit(log_odds((rest**2).sum(axis=1))) / variance
        weighted = (design * weight[:, None, None]).reshape(-1, 3)
        normal = weighted.T @ design.reshape(-1, 3) + np.eye(3) / _PRIOR_BIAS**2
        bias = bias + np.linalg.solve(normal, weighted.T @ rest.ravel() - bias / _PRIOR_BIAS**2)
    good = log_odds(_squared_angles(design, measured, bias[None])) > 0
    return BiasEstimate(bias, float(good.mean() - (of_proposals[0] > 0).mean()))


def _squared_angles(design: np.ndarray, measured: np.ndarray, biases: np.ndarray) -> np.ndarray:
    """``(B, C)`` rad², squared residuals of closures ``(C, 4)`` under B biases ``(B, 3)``; design ``(C, 3, 3)``."""
    by_bias = biases @ design.transpose(2, 1, 0).reshape(3, -1)
    predicted = by_bias.reshape(len(biases), 3, len(design))
    half = np.sqrt(np.einsum("bic,bic->bc", predicted, predicted)) / 2
    along = np.einsum("bic,ci->bc", predicted, measured[:, :3]) / 2
    # The real part of exp(-predicted) ∘ measured.
    cosine = np.cos(half) * measured[:, 3] + np.sinc(half / np.pi) * along
    return np.asarray((2 * np.arccos(np.minimum(np.abs(cosine), 1.0))) ** 2)


def without_bias(graph: ViewGraph, bias: np.ndarray) -> ViewGraph:
    """The graph with ``bias`` ``(3,)`` rad per step taken out of its odometry, whichever way an edge runs.

    Odometry beside the chain was measured otherwise, and has not this bias.

    Translations stay the same in the frame of the older end. Those of several steps change, since later steps follow
    the turns of earlier ones.
    """
    is_forward = torch.from_numpy(runs_forward(graph))[:, None]
    by_bias, shift = graph.steps[:, None] * torch.from_numpy(bias), torch.zeros((graph.num_edges, 3)).double()
    on_chain = graph.is_odometry & torch.from_numpy(~beside_the_chain(graph))
    several = np.flatnonzero((on_chain & (graph.steps > 1)).numpy())
    if len(several):
        older = torch.where(is_forward[:, 0], graph.source, graph.target).numpy()[several]
        of_several = routes_of(graph, several, older)
        by_bias[several], shift[several] = (
            torch.from_numpy(matrix @ bias) for matrix in (of_several.by_bias, of_several.shift_by_bias)
        )
    by_bias = torch.where(on_chain[:, None], by_bias, 0.0)
    turn = rotations.exp(-by_bias)
    measured = graph.target_from_source
    forwards = rotations.multiply(measured, turn)
    backwards = rotations.multiply(rotations.inverse(turn), measured)
    corrected = torch.where(on_chain[:, None], torch.where(is_forward, forwards, backwards), measured)
    unbiased = replace(graph, target_from_source=rotations.canonical(rotations.normalize(corrected)))
    if graph.routes is not None:
        onwards = torch.where(is_forward, measured, rotations.inverse(measured))
        unbiased = replace(unbiased, routes=_turning_less(graph, onwards, by_bias))
    if graph.translation is None:
        return unbiased
    by_older = torch.where(is_forward, graph.translation, rotations.rotate(measured, graph.translation))
    by_older = by_older + torch.where(is_forward, shift, -shift)
    seen = torch.where(is_forward, by_older, rotations.rotate(rotations.inverse(corrected), by_older))
    return replace(unbiased, translation=torch.where(on_chain[:, None], seen, graph.translation))


def _turning_less(graph: ViewGraph, onwards: torch.Tensor, by_bias: torch.Tensor) -> torch.Tensor:
    """Routes ``(R, 38)`` without ``(M, 3)`` rad in the turns ``(M, 4)`` of edges from older to newer ends."""
    assert graph.route is not None and graph.routes is not None
    known = torch.nonzero(graph.route >= 0).squeeze(1)
    by_bias, mean = by_bias[known], by_bias[known] / graph.steps[known, None]
    less = (by_bias * mean - 2 * mean * rotations.log(onwards[known])).sum(dim=1)
    routes, row = graph.routes.clone(), graph.route[known]
    routes[row, 0] = (routes[row, 0] + less).clamp_min(0)
    return routes


def drift_per_bias(graph: ViewGraph, forest: SpanningForest, closure_graph: ClosureGraph) -> np.ndarray:
    """``(N, 3, 3)``: odometry error of each node from its root on, a world-frame rotation vector, per bias."""
    child = np.flatnonzero(forest.parent_edge >= 0)
    edge = forest.parent_edge[child]
    source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
    # A step turns about the body of its earlier node; forwards along the tree or backwards.
    position = closure_graph.paths.position
    earlier = np.where(position[source] < position[target], source, target)
    steps = (graph.steps * graph.is_odometry).numpy()[edge]
    sign = np.where(earlier == child, -1.0, 1.0)
    world_from_body = rotations.to_matrix(rotations.inverse(closure_graph.odometry_orientation)).numpy()
    by_bias = steps[:, None, None] * world_from_body[earlier]
    several = np.flatnonzero(steps > 1)
    if len(several):
        routes = routes_of(graph, edge[several], earlier[several])
        by_bias[several] = world_from_body[earlier[several]] @ routes.by_bias
    step = np.zeros((graph.num_nodes, 9))
    step[child] = (sign[:, None, None] * by_bias).reshape(-1, 9)
    return accumulate_to_root(forest, step).reshape(-1, 3, 3)
