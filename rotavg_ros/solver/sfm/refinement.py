"""Refinement of an SfM view-graph: robust Gauss–Newton steps in the tangent space, first coarse, then shaped.

Coarse steps (ℓ1, round noise; Chatterjee & Govindu 2013) bring the orientations to within the noise, even where the
start was badly wrong. Then the noise's shape Ω in the cameras' frames is estimated from the residuals, and shaped steps
(ℓ½, Chatterjee & Govindu 2018) measure residuals with Ω until they have converged.

A shaped step weights an edge by its expected squared residual: its ends are themselves uncertain, so an edge that
happens to fit is not exact. With r the residual, p the edge's prior weight and v_u the variance of node u,

    w_uv = p_uv (rᵀ Ω r + v_u + v_v)^(−3/4),     v_u = φ / Σ w over the edges of u,     φ = Σ w² rᵀ Ω r / Σ w.

φ / Σ w is the sandwich estimate of a mean's variance (Huber 1967), its numerator pooled over the component. While Ω and
φ are held, the steps lower

    F(R, v) = Σ_uv 4 p_uv (rᵀ Ω r + v_u + v_v)^(1/4) − φ Σ_u log v_u,

since the fourth root is concave and bounded above by its tangents (majorise–minimise). A step towards the bound's
minimum lowers the bound even if it is taken at up to twice its length.

Where edges state about which axes they are exact, and this is believed (``stated/shape.py``), T r replaces r in shaped
steps, with a matrix T for each edge.

A step's length λ is measured in standard errors of the answer: λ² = xᵀ L x / (φ N), with N nodes. It depends neither on
the frames of world and cameras nor on the noise's size.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.sfm.noise_density import NoiseDensity
from rotavg_ros.solver.sfm.noise_shape import NoiseShape
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.step.measure import Measure, l1_weight, l_half_weight
from rotavg_ros.solver.sfm.step.problem import Dispersion, Problem, Step
from rotavg_ros.solver.sfm.step.structure import Structure
from rotavg_ros.solver.sfm.symmetric_rows import distinct_entries, turned
from rotavg_ros.view_graph import ViewGraph

PRIORS = RefinementPriors()
# For ablation of the noise's shape: no axis is more exact than another.
ROUND = replace(PRIORS, shape=replace(PRIORS.shape, least_ratio=1.0))


class EdgeWeights(NamedTuple):
    """What is known of M edges before their residuals are.

    Attributes:
        shaped: ``(M,)`` positive factors of the robust weights in shaped steps.
        coarse: ``(M,)`` the same in coarse steps. CleanNet's scores are used only here: after the coarse steps,
            residuals are more informative.
        unit: ``(3, 3, M)`` T, symmetric, in the targets' frames: residuals r count as T r in shaped steps; None: T = 1.
    """

    shaped: Tensor
    coarse: Tensor
    unit: Tensor | None = None

    def times(self, shaped: Tensor, coarse: Tensor) -> EdgeWeights:
        """Both weights multiplied by factors ``(M,)``."""
        return self._replace(shaped=self.shaped * shaped, coarse=self.coarse * coarse)


class Refined(NamedTuple):
    """Orientations ``(N, 4)``, and Σ w ‖r‖^½ of each component, ``(C,)``, where the shaped steps have led."""

    body_from_world: Tensor
    cost: Tensor


def refine(
    graph: ViewGraph,
    body_from_world: Tensor,
    *,
    structure: Structure | None = None,
    weights: EdgeWeights | None = None,
    priors: RefinementPriors = PRIORS,
) -> Tensor:
    """Reweighted least-squares steps until convergence, at most ``max_steps``; each component independently.

    Args:
        body_from_world: ``(N, 4)`` start.
        structure: default: computed.
        weights: default: ones, without units.

    Returns:
        ``(N, 4)`` float64 orientations.
    """
    structure = Structure.of(graph) if structure is None else structure
    if weights is None:
        ones = torch.ones_like(graph.precision)
        weights = EdgeWeights(ones, ones)
    orientations, steps = coarse_steps(Problem(graph, structure, priors), body_from_world, weights.coarse)
    return settle(graph, orientations, weights, structure, priors, steps).body_from_world


def settle(
    graph: ViewGraph,
    orientations: Tensor,
    weights: EdgeWeights,
    structure: Structure,
    priors: RefinementPriors = PRIORS,
    steps: Tensor | int = 0,
) -> Refined:
    """Shaped steps until convergence, then steps with the noise's density.

    Args:
        orientations: ``(N, 4)``, where coarse steps have led.
        steps: ``(C,)`` number of these, which count among ``max_steps``.
    """
    problem = Problem(graph, structure, priors)
    weights = weights._replace(shaped=weights.shaped.float().clamp(min=priors.least_prior))
    most = priors.max_steps - torch.as_tensor(steps, device=graph.device)
    settled = shaped_steps(problem, orientations, weights, most)
    further = (most - settled.steps).clamp(max=priors.density.max_steps)
    cost = problem.cost(settled.orientations, weights.shaped)
    return Refined(_by_density(problem, settled, weights, further), cost)


class Settled(NamedTuple):
    """Result of ℓ½ steps: orientations ``(N, 4)``, the noise there, variances ``(N,)``, number of steps ``(C,)``."""

    orientations: Tensor
    noise: NoiseShape
    variance: Tensor
    steps: Tensor


def coarse_steps(
    problem: Problem, orientations: Tensor, weight: Tensor, is_over: Callable[[Tensor], Tensor] | None = None
) -> tuple[Tensor, Tensor]:
    """ℓ1 steps until they have settled.

    Args:
        orientations: ``(N, 4)`` start.
        weight: ``(M,)`` positive factors of the robust weights.
        is_over: components ``(C,)`` bool that orientations ``(N, 4)`` need no further steps in; default: none.

    Returns:
        ``(N, 4)`` float64 orientations; the number of steps of each component ``(C,)``.
    """
    priors = problem.priors
    max_steps = min(priors.max_coarse_steps, priors.max_steps - priors.least_shaped_steps)
    orientations = orientations.double()
    prior = weight.float().clamp(min=priors.least_prior)
    is_open = torch.ones_like(problem.roots, dtype=torch.bool)
    measure = Measure(
        problem.round, problem.evenly(priors.coarse_smoothing**2 / 2), l1_weight, problem.everywhere(True)
    )
    steps = torch.zeros_like(problem.roots)
    for _ in range(max_steps):
        typical = problem.typical(problem.sample(orientations))
        step = problem.step(orientations, measure, problem.pooled(orientations, measure, prior), is_open)
        orientations, steps = _turned(orientations, step.turn), steps + is_open
        is_open = is_open & (problem.mean(step.turn.norm(dim=0)) >= priors.coarse_settled * typical)
        if is_over is not None:
            is_open = is_open & ~is_over(orientations)
        if not bool(is_open.any()):
            break
    return orientations, steps


def shaped_steps(problem: Problem, orientations: Tensor, weights: EdgeWeights, max_steps: Tensor | int) -> Settled:
    """ℓ½ steps with the noise's estimated shape and size, until convergence.

    Args:
        max_steps: ``(C,)`` maximum number in each component. What is estimated there is no longer changed after the
            last, so that other components' steps do not matter.
    """
    priors, prior = problem.priors, weights.shaped
    noise = problem.round
    variance = problem.variance_of_means()
    dispersion = Dispersion(*torch.ones(2, len(problem.roots), dtype=orientations.dtype, device=orientations.device))
    step: Step | None = None
    steps = torch.zeros_like(problem.roots)
    max_steps = steps + max_steps
    is_open = max_steps > 0
    is_held, is_single = ~is_open, problem.everywhere(False)
    is_noisy = torch.zeros_like(is_open)
    while bool(is_open.any()):
        unit = None if weights.unit is None else _in_world(weights.unit, orientations, problem.graph.target)
        if step is not None and bool(is_held.all()):
            carried = problem.shapes.carried(noise, orientations)
            measure = Measure(carried, variance, l_half_weight, is_single, step.source_share, unit)
        else:
            sample = problem.sample(orientations, unit)
            is_noisy = torch.where(is_held, is_noisy, problem.typical(sample) > priors.coarse_noise)
            is_single = np.array(is_noisy.tolist())
            noise = problem.shapes.estimate(sample, orientations, noise, is_held)
            measure = Measure(noise, variance, l_half_weight, is_single, unit=unit)
            pooled = problem.pooled(orientations, measure, prior)
            total = None if step is None else step.weight
            dispersion = problem.dispersion(sample, measure, pooled, total).but(is_held, dispersion)
            if step is not None and len(is_held) > 1 and bool(is_held.any()):
                of_edge = is_held[problem.component].index_select(0, problem.graph.source)
                measure = measure._replace(source_share=step.source_share, is_held=of_edge)
        step = problem.step(orientations, measure, problem.pooled(orientations, measure, prior), is_open)
        # Known once weights have settled. Before, larger variances would even weights out, and these enlarge variances.
        size = torch.where(is_held, dispersion.of_errors, dispersion.of_residuals)
        found = (size[problem.component] / step.weight).clamp(min=priors.least_square / 2)
        variance = torch.where(is_open[problem.component], found, variance)
        length = (step.decrement / (dispersion.of_residuals * problem.num_nodes)).sqrt()
        stretch = torch.where(length < priors.stretched, priors.relaxation, 1.0)
        orientations, steps = _turned(orientations, stretch[problem.component] * step.turn), steps + is_open
        is_open = is_open & (length >= priors.converged) & (steps < max_steps)
        is_open = is_open & (problem.largest(step.turn.norm(dim=0)) >= priors.converged_angle)
        # Held, too, where there is no noise and the length is NaN.
        is_held = is_held | ~(length >= priors.held) | ~is_open
    return Settled(orientations, problem.shapes.carried(noise, orientations), variance, steps)


def _by_density(problem: Problem, settled: Settled, weights: EdgeWeights, max_steps: Tensor) -> Tensor:
    """At most ``max_steps`` ``(C,)`` with the density of highest likelihood, where that is not the density of ℓ½."""
    priors, prior = problem.priors, weights.shaped
    orientations, noise, variance, _ = settled
    density: NoiseDensity | None = None
    total: Tensor | None = None
    is_open, number = max_steps > 0, 0
    while bool(is_open.any()):
        unit = None if weights.unit is None else _in_world(weights.unit, orientations, problem.graph.target)
        sample = problem.sample(orientations, unit)
        noise = problem.shapes.carried(noise, orientations)
        measure = Measure(noise, variance, l_half_weight, problem.everywhere(False), unit=unit)
        if density is None:
            density = problem.density(sample, measure, prior)
            is_open = is_open & density.is_other
            if not bool(is_open.any()):
                break
        measure = measure._replace(weigh=density.weigh)
        pooled = problem.pooled(orientations, measure, prior)
        dispersion = problem.dispersion(sample, measure, pooled, total)
        step = problem.step(orientations, measure, pooled, is_open)
        total = step.weight
        of_other = (dispersion.of_errors[problem.component] / step.weight).clamp(min=priors.least_square / 2)
        variance = torch.where(density.is_other[problem.component], of_other, variance)
        orientations = _turned(orientations, step.turn)
        length = (step.decrement / (dispersion.of_residuals * problem.num_nodes)).sqrt()
        number += 1
        is_open = is_open & (length >= priors.converged) & (max_steps > number)
    return orientations


def _in_world(unit: Tensor, orientations: Tensor, target: Tensor) -> Tensor:
    """Matrices ``(3, 3, M)`` in the targets' frames → entries ``(6, M)`` in the world's."""
    matrix = rotations.to_matrix(orientations).permute(1, 2, 0).contiguous()
    return distinct_entries(turned(unit, matrix.index_select(2, target)))


def _turned(orientations: Tensor, turn: Tensor) -> Tensor:
    """The orientations ``(N, 4)`` after turns of the world's frame ``(3, N)`` radians."""
    return rotations.normalize(rotations.multiply(orientations, rotations.exp(turn.t())))
