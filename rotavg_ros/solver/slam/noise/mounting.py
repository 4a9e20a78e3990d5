"""A loop-closure sensor whose mounting differs from the stated one.

A camera's closures are transformed into the body's frame by its mounting, while the odometry is in the body's frame. If
the mounting is off by a rotation C = exp(c), c in the body's frame, every closure states

    M = C R C⁻¹ = R exp((R⁻¹ − I) c) + O(c²),       t = C t_body

instead of R and t_body. A closure without a turn gives no information on c; one between opposite headings is off by
twice the horizontal part of c. The component of c about an axis that all turns share cannot be determined, and does not
matter.

The data only show that closures and odometry turn about different axes. If these are far apart, a frame was mistaken,
and odometry's is the body's. A few degrees may as well be an error of odometry, as with visual odometry of KITTI.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Proposals come from closures that turn by more than the first, rad: the third is their largest number, those that span
# the least odometry first. Each is paired with the next one whose axis differs by more than the second, rad, if any.
_LEAST_TURN, _LEAST_APART, _MAX_PROPOSALS = np.radians(20.0), np.radians(20.0), 60
# More closures than this do not improve an estimate of three numbers.
_MAX_CLOSURES = 1500
_COMPONENTS = 3
_EM_ITERATIONS = 10
# Two mountings are distinct if they differ by more than this, rad.
_FAR = np.radians(60.0)
# A mounting is worth a search if closures, taken as independent, are likelier than with the stated one by the first in
# all and by the second each, nats. Smaller gains are not worth the time; small deviations are found by the posterior
# itself. The noise is that under the stated mounting, so F decides between two mountings.
_WORTH, _WORTH_EACH = 10.0, 0.05
# Axes that differ by less, rad, are worth neither a search nor a warning.
ALIKE = np.radians(1.0)
# A shorter vector has no axis.
_NO_TURN = 1e-6
# Prior of a mounting that may be anything: variance of a component of a random rotation's vector, rad².
ANY_TURN = rotations.RANDOM_VARIANCE


def without_mounting(graph: ViewGraph, mounting: np.ndarray) -> ViewGraph:
    """The graph with ``mounting`` ``(3,)``, c in rad, taken out of its closures; C R C⁻¹ → R, t → C⁻¹ t."""
    closures = torch.nonzero(~graph.is_odometry).squeeze(1)
    body_from_sensor = rotations.exp(torch.from_numpy(-mounting)).expand(len(closures), 4)
    measured = rotations.multiply(body_from_sensor, graph.target_from_source[closures])
    measured = rotations.multiply(measured, rotations.inverse(body_from_sensor))
    measured = rotations.canonical(rotations.normalize(measured))
    turned = replace(graph, target_from_source=_with(graph.target_from_source, closures, measured))
    if graph.translation is None:
        return turned
    seen = rotations.rotate(body_from_sensor, graph.translation[closures])
    return replace(turned, translation=_with(graph.translation, closures, seen))


def is_about_as_said(mounting: np.ndarray, spread: float) -> bool:
    """Whether c ``(3,)`` rad is likelier an inaccuracy of standard deviation ``spread``, rad, than a mistake."""
    near = spread**-2
    return bool((mounting**2).sum() * (near - 1 / ANY_TURN) < 3 * np.log(near * ANY_TURN))


def estimate_mountings(graph: ViewGraph, closure_graph: ClosureGraph, noise: NoiseModel) -> list[np.ndarray]:
    """Mountings that closures suggest when compared with odometry, however far from the stated one.

    With quaternions (v, w) of M and of the odometry's R, v_M = C v_R. One or two closures propose a C, which is refined
    by expectation–maximisation (Wahba's problem, by Kabsch's method). There are two candidates: the likeliest one, and
    the likeliest of those far from it. Where all turns are small, or half a turn, a sensor that is upside down would
    see about the same.

    Args:
        graph: the view-graph.
        closure_graph: its contraction.
        noise: of steps and closures.

    Returns:
        c ``(3,)`` rad of each that is worth a search, the likeliest first.
    """
    segments = closure_graph.num_segments
    may_tell = np.append(np.zeros(segments, dtype=bool), _may_tell(graph).numpy()[closure_graph.view_graph_edge])
    closure = np.flatnonzero(may_tell & np.isfinite(closure_graph.path_steps))
    closure = closure[:: max(1, len(closure) // _MAX_CLOSURES)]
    ends = (closure_graph.nodes[each[closure]] for each in (closure_graph.source, closure_graph.target))
    source, target = (closure_graph.odometry_orientation[torch.from_numpy(each)] for each in ends)
    turned = rotations.canonical(rotations.multiply(target, rotations.inverse(source))).numpy()
    edge = closure_graph.view_graph_edge[closure - segments]
    measured = rotations.canonical(graph.target_from_source[edge]).numpy()
    variance = np.maximum(closure_graph.path_steps[closure], 1.0) * noise.step_variance + noise.closure_variance
    highest = noise.prior_log_odds - noise.components / 2 * np.log(2 * np.pi * variance)

    def log_odds(sensor_from_body: np.ndarray) -> np.ndarray:
        cosine = np.abs(_conjugated(sensor_from_body, turned) * measured).sum(axis=-1)
        angle = 2 * np.arccos(np.minimum(cosine, 1.0))
        uniform = log_uniform_density(angle.ravel(), noise.components).reshape(angle.shape)
        return np.asarray(highest - angle**2 / (2 * variance) - uniform)

    def log_likelihood(sensor_from_body: np.ndarray) -> np.ndarray:
        from_said = _angle(sensor_from_body) ** 2 / (2 * ANY_TURN)
        return np.asarray(np.logaddexp(0, log_odds(sensor_from_body)).sum(axis=1) - from_said)

    proposed = _proposals(turned, measured, variance)
    for _ in range(_EM_ITERATIONS):
        sign = np.sign((_conjugated(proposed, turned) * measured).sum(axis=-1))
        weight = sign * expit(log_odds(proposed)) / variance
        proposed = _nearest_rotation(np.einsum("pc,ci,cj->pij", weight, measured[:, :3], turned[:, :3]))
    proposed = proposed[np.argsort(-log_likelihood(proposed), kind="stable")]
    is_other = _angle(np.swapaxes(proposed[:1], 1, 2) @ proposed) > _FAR
    found = np.concatenate((proposed[:1], proposed[is_other][:1]))
    likelihood = log_likelihood(found)
    worth = likelihood > log_likelihood(np.eye(3)[None]) + max(_WORTH, _WORTH_EACH * len(closure))
    return _vectors(found[worth])


def may_be_told(graph: ViewGraph) -> bool:
    """Whether at least as many closures turn as c has components, since a single false one must not determine c."""
    turned = rotations.angle(graph.target_from_source[_may_tell(graph)])
    return int((turned > _LEAST_TURN).sum()) >= _COMPONENTS


def between_axes(graph: ViewGraph) -> list[np.ndarray]:
    """If odometry turns about a single axis and closures about another one: c ``(3,)`` rad, for both signs of the axis.

    This is a robot in the plane whose closures come from a tilted planar sensor; nothing else looks like this.
    """
    axes = []
    for edges in (graph.is_odometry, _may_tell(graph)):
        alone = graph.select_edges(torch.nonzero(edges).squeeze(1))
        if alone.num_edges == 0 or alone.rotation_components != 1:
            return []
        turns = rotations.log(alone.target_from_source[alone.tells_dimension])
        axes.append(torch.linalg.eigh(turns.T @ turns)[1][:, -1].numpy())
    pairs = np.outer(axes[1], axes[0])
    return _vectors(_nearest_rotation(np.stack((pairs, -pairs))))


def _vectors(sensor_from_body: np.ndarray) -> list[np.ndarray]:
    """Rotation vectors ``(3,)`` rad of rotations ``(P, 3, 3)``."""
    return list(rotations.log(rotations.from_matrix(torch.from_numpy(sensor_from_body))).numpy())


def _may_tell(graph: ViewGraph) -> Tensor:
    """``(M,)`` bool, closures that nobody has rejected."""
    return ~graph.is_odometry & (graph.label != EdgeLabel.REJECTED)


def _proposals(turned: np.ndarray, measured: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """``(P, 3, 3)`` C that map one closure's axis, or those of two, from odometry ``(C, 4)`` to the measurement."""
    tells = np.flatnonzero(2 * np.arccos(np.minimum(turned[:, 3], 1.0)) > _LEAST_TURN)
    tells = tells[np.argsort(variance[tells], kind="stable")][:_MAX_PROPOSALS]
    if len(tells) == 0:
        return np.zeros((0, 3, 3))
    of_body, of_sensor = (_axes(rows[tells]) for rows in (turned, measured))
    following = np.add.outer(np.arange(len(tells)), np.arange(len(tells))) % len(tells)
    is_apart = (np.abs(of_body @ of_body.T) < np.cos(_LEAST_APART))[following[:, :1], following]
    other = np.take_along_axis(following, is_apart.argmax(axis=1)[:, None], axis=1)[:, 0]
    pairs = of_sensor[:, :, None] * of_body[:, None]
    pairs = pairs + is_apart.any(axis=1)[:, None, None] * pairs[other]
    return _nearest_rotation(pairs)


def _angle(matrices: np.ndarray) -> np.ndarray:
    """Angles ``(…)`` rad of rotations ``(…, 3, 3)``."""
    return np.asarray(np.arccos(((np.trace(matrices, axis1=-2, axis2=-1) - 1) / 2).clip(-1, 1)))


def _axes(quaternions: np.ndarray) -> np.ndarray:
    """Unit axes ``(n, 3)`` of rotations ``(n, 4)``."""
    vectors = quaternions[:, :3]
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(_NO_TURN))


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotations that take a nearest to b, given Σ b aᵀ ``(…, 3, 3)``; if several do, that of the least angle."""
    size = np.linalg.norm(matrix, axis=(-2, -1))[..., None, None]
    left, _, right = np.linalg.svd(matrix + _NO_TURN * size * np.eye(3))
    left[..., 2] *= (np.linalg.det(left) * np.linalg.det(right))[..., None]
    return np.asarray(left @ right)


def _conjugated(sensor_from_body: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """``(P, C, 4)``: C R C⁻¹ of each C ``(P, 3, 3)`` and R ``(C, 4)``."""
    vector = np.einsum("pij,cj->pci", sensor_from_body, turned[:, :3])
    return np.concatenate((vector, np.broadcast_to(turned[:, 3:], (*vector.shape[:2], 1))), axis=-1)


def turned_per_mounting(target_from_source: Tensor) -> np.ndarray:
    """``(n, 3, 3)`` M⁻¹ − I: the error of closures ``(n, 4)`` per c, in the source's frame."""
    return np.asarray(rotations.to_matrix(rotations.inverse(target_from_source)).numpy() - np.eye(3))


def _with(values: Tensor, rows: Tensor, of_rows: Tensor) -> Tensor:
    changed = values.clone()
    changed[rows] = of_rows
    return changed
