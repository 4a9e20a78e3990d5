"""The likelihood of all edges under an answer, false ones included, and the likeliest answer near a start.

The probability that an edge is good falls with the angle θ between the orientations of its ends, since views with very
different orientations see little in common. Good edges follow Student's t about the answer's prediction; for false
edges the stated angle has a free density, and the axis is uniform. With r the residual and m the edge's own rotation,

    p = π(θ) t(r; s) + (1 − π(θ)) f(|m|),   logit π = a + b θ, b ≤ 0.

Densities are in units of the uniform one over all rotations. a, b, s and f are estimated for each graph together with
the orientations (expectation and maximisation). An answer in which all views have the same orientation explains
registrations that failed near the identity as good ones; but then every pair should have been registered, and edges
with large angles contradict that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit, log_expit

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianPattern
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.sfm.priors import ConsensusPriors

# Largest change of a and b in one round of Newton's method; both are of order one to ten.
_LONGEST_STEP = 2.0


@dataclass(frozen=True)
class Edges:
    """M edges that connect N nodes.

    Attributes:
        num_nodes: N.
        source, target: ``(M,)``.
        measured: ``(4, M)`` target_from_source.
        is_trusted: ``(M,)`` bool, edges labelled as good.
    """

    num_nodes: int
    source: np.ndarray
    target: np.ndarray
    measured: np.ndarray
    is_trusted: np.ndarray

    @cached_property
    def pattern(self) -> LaplacianPattern:
        """Sparsity pattern of the steps' systems."""
        return LaplacianPattern(self.num_nodes, self.source, self.target, np.zeros(1, dtype=np.int64))


@dataclass(frozen=True)
class Fitted:
    """The likeliest answer near a start.

    Attributes:
        body_from_world: ``(4, N)``.
        good: ``(M,)`` probability that each edge is good.
        log_likelihood: nats, of all edges; less for trusted ones that are no good ones.
        scale: rad, scale s of good edges.
    """

    body_from_world: np.ndarray
    good: np.ndarray
    log_likelihood: float
    scale: float


@dataclass
class Density:
    """Parameters of the density, updated by expectation and maximisation."""

    priors: ConsensusPriors
    shell: np.ndarray
    scale: float
    chance: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        shells = np.array(self.priors.shells)
        self._volume = np.diff(shells - np.sin(shells)) / np.pi
        self._is_false(np.ones(len(self.shell)))

    def _is_false(self, probability: np.ndarray) -> None:
        volume = self._volume
        count = np.bincount(self.shell, probability, len(volume)) + self.priors.shell_edges * volume
        self._log_false = np.log(count / count.sum() / volume)

    def logs(self, square: np.ndarray, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log joint densities ``(M,)`` of each edge and its being good, and of its being false."""
        free = self.priors.freedom
        log_t = (
            math.lgamma((free + 3) / 2)
            - math.lgamma(free / 2)
            - 1.5 * math.log(free * math.pi * self.scale**2)
            - (free + 3) / 2 * np.log1p(square / (free * self.scale**2))
            + math.log(8 * math.pi**2)
        )
        odds = self.chance[0] + self.chance[1] * turned
        return log_expit(odds) + log_t, log_expit(-odds) + self._log_false[self.shell]

    def maximise(self, good: np.ndarray, square: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """Updates all parameters but the orientations; returns the weights ``(M,)`` rad⁻² of their least squares."""
        free = self.priors.freedom
        self._is_false(1 - good)
        rows = np.stack((np.ones(len(turned)), turned))
        expected = expit(self.chance @ rows)
        curvature = (rows * (expected * (1 - expected))) @ rows.T + self.priors.curvature * np.eye(2)
        slope = rows @ (good - expected) - self.priors.curvature * self.chance
        self.chance += np.clip(np.linalg.solve(curvature, slope), -_LONGEST_STEP, _LONGEST_STEP)
        self.chance[1] = min(self.chance[1], 0.0)
        weight = good * (free + 3) / (free + square / self.scale**2)
        scale = math.sqrt(float(weight @ square) / (3 * max(float(good.sum()), 1.0)))
        self.scale = max(scale, self.priors.least_scale)
        return np.asarray(weight / self.scale**2)


def fitted(edges: Edges, body_from_world: np.ndarray, priors: ConsensusPriors) -> Fitted:
    """The likeliest answer near ``body_from_world`` ``(4, N)``."""
    stated = _length(quaternion_rows.log(edges.measured))
    shell = np.clip(np.searchsorted(priors.shells, stated, side="right") - 1, 0, len(priors.shells) - 2)
    density = Density(priors, shell, priors.closing[-1])
    last = -math.inf
    for _ in range(priors.max_rounds):
        at_source, at_target = body_from_world[:, edges.source], body_from_world[:, edges.target]
        turned = _length(quaternion_rows.log(quaternion_rows.multiply(at_target, quaternion_rows.inverse(at_source))))
        residual = quaternion_rows.log(
            quaternion_rows.residual(body_from_world, edges.measured, edges.source, edges.target)
        )
        square = np.einsum("in,in->n", residual, residual)
        log_good, log_false = density.logs(square, turned)
        log_false = np.where(edges.is_trusted, -np.inf, log_false)
        either = np.logaddexp(log_good, log_false)
        is_contradicted = edges.is_trusted & (square > NUMBERS.outlier_angle**2)
        good = np.exp(log_good - either)
        log_likelihood = float(either.sum()) - priors.contradicted * int(is_contradicted.sum())
        if abs(log_likelihood - last) < priors.settled:
            break
        last = log_likelihood
        weight = density.maximise(good, square, turned)
        # However far off a trusted edge is, it weighs as one that errs by the scale about each axis.
        weight = np.where(edges.is_trusted, np.maximum(weight, density.scale**-2), weight)
        # The floor keeps the system solvable where a node has only false edges.
        floor = 1e-9 * float(weight.max())
        step = edges.pattern.factorize(np.maximum(weight, floor)).fit(residual.T)
        turn = quaternion_rows.exp(np.ascontiguousarray(step.T))
        body_from_world = quaternion_rows.normalize(quaternion_rows.multiply(body_from_world, turn))
    return Fitted(body_from_world, good, log_likelihood, density.scale)


def _length(vector: np.ndarray) -> np.ndarray:
    """Lengths of the columns of ``(3, M)``."""
    return np.asarray(np.sqrt(np.einsum("in,in->n", vector, vector)))
