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

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.sfm.noise_density import NoiseDensity
from rotavg_ros.solver.sfm.noise_shape import NoiseShape
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.step import Measure, Problem, Structure, l1_weight, l_half_weight
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


class Start(NamedTuple):
    """Where a refinement may begin.

    Attributes:
        body_from_world: ``(N, 4)``.
        coarse: ``(M,)`` positive factors of the robust weights in coarse steps from there.
        among: ``(C,)`` bool, components that may begin there; None: all.
        is_settled: coarse steps on a subset of the edges led there; more are taken only if the start differs from the
            best one and is not much worse.
    """

    body_from_world: Tensor
    coarse: Tensor
    among: Tensor | None = None
    is_settled: bool = False


class Begun(NamedTuple):
    """Where coarse steps have led.

    Attributes:
        body_from_world: ``(N, 4)``.
        coarse: ``(M,)`` the weights that these steps used.
        steps: number of steps.
        rival: another solution in some components, whose cost is too close for so few steps to decide; None: nowhere.
    """

    body_from_world: Tensor
    coarse: Tensor
    steps: int
    rival: Begun | None = None


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
    begun = begin(graph, [Start(body_from_world, weights.coarse)], weights.shaped, structure, priors)
    return settle(graph, begun, weights, structure, priors)


def begin(
    graph: ViewGraph, starts: Sequence[Start], shaped: Tensor, structure: Structure, priors: RefinementPriors = PRIORS
) -> Begun:
    """Coarse steps from several starts; each component keeps the one with clearly the lowest Σ w ‖r‖^½ afterwards.

    That is the cost of the shaped steps, a few of which are taken to tell starts apart. A likelihood would not do: its
    scale tends to zero where an answer fits as many edges exactly as there are nodes.

    Args:
        shaped: ``(M,)`` positive factors of the robust weights in shaped steps.
    """
    problem, component = Problem(graph, structure, priors), structure.component
    shaped = shaped.float().clamp(min=priors.least_prior)
    first, *others = starts
    orientations, steps = _coarse(problem, first)
    if not others:
        return Begun(orientations, first.coarse, steps)
    # Components in which starts are told apart by further steps; in the others, the coarse steps decide.
    is_close = torch.zeros_like(structure.roots, dtype=torch.bool)
    for other in others:
        if not other.is_settled:
            is_close = is_close | (True if other.among is None else other.among)

    def told(orientations: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Orientations after the further steps, and their cost ``(C,)``."""
        if bool(is_close.any()):
            few = min(priors.telling_steps, priors.max_steps - steps)
            further = _shaped(problem, orientations, EdgeWeights(shaped, shaped), few).orientations
            orientations = torch.where(is_close[component, None], further, orientations)
        return orientations, problem.cost(orientations, shaped)

    orientations, least = told(orientations, steps)
    best, rival = Begun(orientations, first.coarse, steps), None
    barely, nearest = 1 - priors.same_valley, torch.full_like(least, torch.inf)
    for other in others:
        may_begin = torch.ones_like(is_close) if other.among is None else other.among
        if other.is_settled:
            cost, apart = problem.cost(other.body_from_world, shaped), _share_apart(problem, best, other)
            may_begin = may_begin & (cost < (1 + priors.by_a_part) * least) & (apart > priors.rival_share)
            if not bool(may_begin.any()):
                continue
        another, more = _coarse(problem, other)
        another, cost = told(another, more)
        found = Begun(another, other.coarse, max(best.steps, more))
        is_better = may_begin & (cost < barely * least)
        is_rival = may_begin & ~is_better & (cost < torch.minimum(least / barely, nearest))
        is_rival &= _share_apart(problem, best, found) > priors.rival_share
        if bool(is_rival.any()):
            rival, nearest = _where(problem, is_rival, found, rival or best), torch.where(is_rival, cost, nearest)
        if bool(is_better.any()):
            best, least = _where(problem, is_better, found, best), torch.where(is_better, cost, least)
    is_rival = nearest < least / barely  # a better start may have been found since
    return best._replace(rival=_where(problem, is_rival, rival, best) if rival and bool(is_rival.any()) else None)


def _where(problem: Problem, chosen: Tensor, one: Begun, other: Begun) -> Begun:
    """``one`` in the chosen components ``(C,)``, ``other`` elsewhere."""
    of_node = chosen[problem.component]
    orientations = torch.where(of_node[:, None], one.body_from_world, other.body_from_world)
    coarse = torch.where(of_node[problem.graph.source], one.coarse, other.coarse)
    return Begun(orientations, coarse, max(one.steps, other.steps))


def _share_apart(problem: Problem, one: Begun, other: Begun | Start) -> Tensor:
    """``(C,)`` share of each component's nodes whose orientations in the two solutions are far apart."""
    component, count = problem.component, len(problem.roots)
    turn = rotations.multiply(rotations.inverse(one.body_from_world), other.body_from_world)
    moment = turn.new_zeros(count, 4, 4).index_add_(0, component, turn[:, :, None] * turn[:, None])
    gauge = torch.linalg.eigh(moment).eigenvectors[:, :, -1]
    return problem.mean((rotations.angle_between(turn, gauge[component]) > NUMBERS.outlier_angle).double())


def settle_best(
    graph: ViewGraph, begun: Begun, weights: EdgeWeights, structure: Structure, priors: RefinementPriors = PRIORS
) -> tuple[Tensor, EdgeWeights]:
    """:func:`settle` from ``begun`` and from its rival; each component keeps the result of lower cost.

    Returns:
        ``(N, 4)`` orientations, and the weights of the coarse steps that led there.
    """
    weights = weights._replace(coarse=begun.coarse)
    orientations = settle(graph, begun, weights, structure, priors)
    if begun.rival is None:
        return orientations, weights
    problem, rival = Problem(graph, structure, priors), begun.rival
    other = settle(graph, rival, weights, structure, priors)
    is_better = problem.cost(other, weights.shaped.float()) < problem.cost(orientations, weights.shaped.float())
    ended = _where(
        problem, is_better, rival._replace(body_from_world=other), begun._replace(body_from_world=orientations)
    )
    return ended.body_from_world, weights._replace(coarse=ended.coarse)


def settle(
    graph: ViewGraph,
    begun: Begun,
    weights: EdgeWeights,
    structure: Structure,
    priors: RefinementPriors = PRIORS,
) -> Tensor:
    """Shaped steps until convergence, as many as are left, then steps with the noise's density; ``(N, 4)``."""
    problem = Problem(graph, structure, priors)
    weights = weights._replace(shaped=weights.shaped.float().clamp(min=priors.least_prior))
    settled = _shaped(problem, begun.body_from_world, weights, priors.max_steps - begun.steps)
    further = min(priors.density.max_steps, priors.max_steps - begun.steps - settled.steps)
    return _by_density(problem, settled, weights, further) if further > 0 else settled.orientations


class _Settled(NamedTuple):
    """Result of ℓ½ steps: orientations ``(N, 4)``, the noise there, variances ``(N,)``, number of steps."""

    orientations: Tensor
    noise: NoiseShape
    variance: Tensor
    steps: int


def _coarse(problem: Problem, start: Start) -> tuple[Tensor, int]:
    """ℓ1 steps until they have settled; also returns their number."""
    priors = problem.priors
    max_steps = min(priors.max_coarse_steps, priors.max_steps - priors.least_shaped_steps)
    orientations = start.body_from_world.double()
    prior = start.coarse.float().clamp(min=priors.least_prior)
    measure = Measure(problem.round, problem.evenly(priors.coarse_smoothing**2 / 2), l1_weight, torch.float32)
    is_open = torch.ones_like(problem.roots, dtype=torch.bool)
    for number in range(max_steps):
        typical = problem.typical(problem.sample(orientations))
        step = problem.step(orientations, measure, problem.pooled(orientations, measure, prior), is_open)
        orientations = _turned(orientations, step.turn)
        is_open = is_open & (problem.mean(step.turn.norm(dim=0)) >= priors.coarse_settled * typical)
        if not bool(is_open.any()):
            return orientations, number + 1
    return orientations, max(max_steps, 0)


def _shaped(problem: Problem, orientations: Tensor, weights: EdgeWeights, max_steps: int) -> _Settled:
    """ℓ½ steps with the noise's estimated shape and size, until convergence."""
    priors, prior = problem.priors, weights.shaped
    noise = problem.round
    variance = problem.variance_of_means()
    dispersion = torch.ones_like(problem.roots, dtype=orientations.dtype)
    dtype, step = torch.float32, None
    is_open = torch.ones_like(problem.roots, dtype=torch.bool)
    is_held = torch.zeros_like(is_open)
    for number in range(max_steps):
        unit = None if weights.unit is None else _in_world(weights.unit, orientations, problem.graph.target)
        if step is not None and bool(is_held.all()):
            carried = problem.shapes.carried(noise, orientations)
            measure = Measure(carried, variance, l_half_weight, dtype, step.source_share, unit)
        else:
            sample = problem.sample(orientations, unit)
            is_noisy = problem.is_well_knit and bool((problem.typical(sample) > priors.coarse_noise).all())
            dtype = torch.float32 if is_noisy else torch.float64
            noise = problem.shapes.estimate(sample, orientations, noise, is_held)
            measure = Measure(noise, variance, l_half_weight, dtype, unit=unit)
            pooled = problem.pooled(orientations, measure, prior)
            dispersion = torch.where(is_held, dispersion, problem.dispersion(sample, measure, pooled))
        step = problem.step(orientations, measure, problem.pooled(orientations, measure, prior), is_open)
        variance = (dispersion[problem.component] / step.weight).clamp(min=priors.least_square / 2)
        length = (step.decrement / (dispersion * problem.num_nodes)).sqrt()
        stretch = torch.where(length < priors.stretched, priors.relaxation, 1.0)
        orientations = _turned(orientations, stretch[problem.component] * step.turn)
        is_held = is_held | ~(length >= priors.held)  # also where there is no noise and the length is NaN
        is_open = is_open & (length >= priors.converged)
        is_open = is_open & (problem.largest(step.turn.norm(dim=0)) >= priors.converged_angle)
        if not bool(is_open.any()):
            max_steps = number + 1
            break
    return _Settled(orientations, problem.shapes.carried(noise, orientations), variance, max_steps)


def _by_density(problem: Problem, settled: _Settled, weights: EdgeWeights, max_steps: int) -> Tensor:
    """Steps with the density of highest likelihood, in components where that is not the density of ℓ½."""
    priors, prior = problem.priors, weights.shaped
    orientations, noise, variance, _ = settled
    density: NoiseDensity | None = None
    is_open = torch.ones_like(problem.roots, dtype=torch.bool)
    for _ in range(max_steps):
        unit = None if weights.unit is None else _in_world(weights.unit, orientations, problem.graph.target)
        sample = problem.sample(orientations, unit)
        noise = problem.shapes.carried(noise, orientations)
        measure = Measure(noise, variance, l_half_weight, torch.float64, unit=unit)
        if density is None:
            density = problem.density(sample, measure, prior)
            is_open = density.is_other
            if not bool(is_open.any()):
                break
        measure = measure._replace(weigh=density.weigh)
        pooled = problem.pooled(orientations, measure, prior)
        dispersion = problem.dispersion(sample, measure, pooled)
        step = problem.step(orientations, measure, pooled, is_open)
        of_other = (dispersion[problem.component] / step.weight).clamp(min=priors.least_square / 2)
        variance = torch.where(density.is_other[problem.component], of_other, variance)
        orientations = _turned(orientations, step.turn)
        length = (step.decrement / (dispersion * problem.num_nodes)).sqrt()
        is_open = is_open & (length >= priors.converged)
        if not bool(is_open.any()):
            break
    return orientations


def _in_world(unit: Tensor, orientations: Tensor, target: Tensor) -> Tensor:
    """Matrices ``(3, 3, M)`` in the targets' frames → entries ``(6, M)`` in the world's."""
    matrix = rotations.to_matrix(orientations).permute(1, 2, 0).contiguous()
    return distinct_entries(turned(unit, matrix.index_select(2, target)))


def _turned(orientations: Tensor, turn: Tensor) -> Tensor:
    """The orientations ``(N, 4)`` after turns of the world's frame ``(3, N)`` radians."""
    return rotations.normalize(rotations.multiply(orientations, rotations.exp(turn.t())))
