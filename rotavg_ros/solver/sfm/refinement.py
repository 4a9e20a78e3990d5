"""Refinement of an SfM view-graph: robust Gauss–Newton steps on the tangent space, coarse ones and then shaped ones.

Coarse steps (ℓ1, round noise; Chatterjee & Govindu 2013) bring the orientations to within the noise, however wrong they
were in places. Then the noise's shape in the cameras' frames is estimated from the residuals, and the last steps (ℓ½,
Chatterjee & Govindu 2018) measure residuals by it: what an edge says about the exact axes counts for more than the
rest. Its scale comes along, so nothing is tuned to a graph's noise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import SLICE_EDGES, EdgeResiduals, measured_rows
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.threads import for_each, slices, stretches
from rotavg_ros.solver.sfm.block_laplacian import Arrivals, BlockLaplacian, factorised
from rotavg_ros.solver.sfm.noise_shape import NoiseShape
from rotavg_ros.view_graph import ViewGraph

# Coarse steps end early where they are settled; the last ones are shaped.
MAX_STEPS = 11
_SHAPED_STEPS = 3
# Coarse steps are settled once they turn nodes by less than this share of the typical residual, on average.
_SETTLED = 0.2
_CONVERGED_STEP = np.radians(0.001)
_MIN_PRIOR = 1e-6
# Single precision leaves a residual exact to 10⁻⁷ rad. Where residuals typically are ten thousand times as large, no
# answer shows it. Double precision is for more exact measurements, and for graphs so loose that errors add up.
_COARSE_NOISE = 1e-3
_MIN_RESIDUAL = np.radians(0.001)
# A graph with fewer neighbours than this is no case for conjugate gradients alone.
_WELL_KNIT_DEGREE = 12
# Edges of a component whose residuals tell the noise's shape and size: more would change nothing.
_MAX_SAMPLE = 8_000


class _Step(NamedTuple):
    """ρ(r), and how exactly a step is solved.

    Attributes:
        weigh: robust weights ρ'(r)/r from squared residuals.
        smoothing: residuals below it count as this: radians, or standard deviations of the noise.
        tolerance: of conjugate gradients, radians.
        relative_tolerance: the same as a share of the step; the next step corrects what this one lacks.
    """

    weigh: Callable[[Tensor], Tensor]
    smoothing: float
    tolerance: float
    relative_tolerance: float


def _l1(square: Tensor) -> Tensor:
    """|r|⁻¹."""
    return square.rsqrt()


def _l_half(square: Tensor) -> Tensor:
    """|r|^(−3/2), in a fifth of the time that a power takes."""
    return (square * square.sqrt()).rsqrt_()


_COARSE = _Step(_l1, np.radians(1.0), 1e-6, 1e-3)
_SHAPED = _Step(_l_half, 0.1, 1e-6, 1e-3)


def refine(
    graph: ViewGraph,
    body_from_world: Tensor,
    roots: Tensor,
    max_steps: int = MAX_STEPS,
    *,
    shaped_steps: int = _SHAPED_STEPS,
    prior_weight: Tensor | None = None,
    coarse_weight: Tensor | None = None,
    component: Tensor | None = None,
    edges: SortedEdges | None = None,
) -> Tensor:
    """At most ``max_steps`` reweighted least-squares steps; every component by itself.

    Of few steps, all are shaped. CleanNet's scores belong into the coarse ones alone: after these, residuals know more.

    Args:
        body_from_world: ``(N, 4)`` start.
        roots: ``(C,)`` a node of each connected component, in the components' order; they are held fixed.
        shaped_steps: how many of them are shaped at most.
        prior_weight: ``(M,)`` in [0, 1], multiplied to every robust weight; default 1.
        coarse_weight: the same for the coarse steps only.
        component: ``(N,)`` connected components; default: computed.
        edges: the graph's edges sorted; default: computed.

    Returns:
        ``(N, 4)`` float64 orientations.
    """
    component = graph.components() if component is None else component
    edges = SortedEdges.of(graph) if edges is None else edges
    problem = _Problem(graph, roots, component, edges)
    prior = torch.ones_like(graph.precision) if prior_weight is None else prior_weight
    coarse_prior = prior if coarse_weight is None else prior * coarse_weight
    orientations = body_from_world.double()
    moving = torch.ones_like(roots, dtype=torch.bool)
    for _ in range(max_steps - shaped_steps):
        typical = problem.typical(problem.some_residuals(orientations))
        orientations, turned = problem.step(orientations, problem.round, coarse_prior, _COARSE, moving, torch.float32)
        moving = moving & (problem.mean(turned) >= _SETTLED * typical)
        if not bool(moving.any()):
            break
    moving = torch.ones_like(moving)
    shape = problem.round
    for _ in range(min(max_steps, shaped_steps)):
        residual = problem.some_residuals(orientations)
        is_noisy = problem.is_well_knit and bool((problem.typical(residual) > _COARSE_NOISE).all())
        dtype = torch.float32 if is_noisy else torch.float64
        shape = problem.shape(residual, orientations, shape)
        orientations, turned = problem.step(orientations, shape, prior, _SHAPED, moving, dtype)
        moving = moving & (problem.largest(turned) >= _CONVERGED_STEP)
        if not bool(moving.any()):
            break
    return orientations


class _Problem:
    """What stays the same from step to step, of a graph of C components."""

    def __init__(self, graph: ViewGraph, roots: Tensor, component: Tensor, edges: SortedEdges) -> None:
        self.graph, self.roots, self.component = graph, roots, component
        self.arrivals = Arrivals(edges)
        self.round = NoiseShape.round(graph.num_nodes, graph.device)
        self.is_well_knit = 2 * graph.num_edges >= _WELL_KNIT_DEGREE * graph.num_nodes
        self.num_nodes = torch.bincount(component, minlength=len(roots))
        of_edge = component[graph.source]
        self.redundancy = torch.bincount(of_edge, minlength=len(roots)) - self.num_nodes + 1
        self.some = graph.select_edges(_evenly_spread(of_edge, len(roots)))
        self.component_of_some = component[self.some.source]
        self.count_of_some = torch.bincount(self.component_of_some, minlength=len(roots)).clamp(min=1)
        self.measured = measured_rows(graph.target_from_source, torch.float32)

    def mean(self, value: Tensor) -> Tensor:
        """Means ``(C,)`` of the nodes' values ``(N,)``."""
        return value.new_zeros(len(self.roots)).index_add_(0, self.component, value) / self.num_nodes

    def largest(self, value: Tensor) -> Tensor:
        """Maxima ``(C,)`` of the nodes' values ``(N,)``, which are not negative."""
        return value.new_zeros(len(self.roots)).scatter_reduce(0, self.component, value, "amax")

    def some_residuals(self, orientations: Tensor) -> Tensor:
        """Rotation vectors ``(3, K)``."""
        return EdgeResiduals(self.some, orientations).vectors(slice(0, self.some.num_edges))

    def typical(self, residual: Tensor) -> Tensor:
        """Geometric mean of some residuals' lengths in each component, ``(C,)`` rad."""
        logarithm = (residual * residual).sum(dim=0).clamp(min=_MIN_RESIDUAL**2).log() / 2
        total = logarithm.new_zeros(len(self.roots)).index_add_(0, self.component_of_some, logarithm)
        return torch.exp(total / self.count_of_some)

    def shape(self, residual: Tensor, orientations: Tensor, before: NoiseShape) -> NoiseShape:
        """The noise's shape as some residuals have it."""
        ends = self.some.source, self.some.target
        return NoiseShape.estimate(residual.t(), *ends, orientations, self.component, self.redundancy, before)

    def step(
        self,
        orientations: Tensor,
        shape: NoiseShape,
        prior: Tensor,
        settings: _Step,
        moving: Tensor,
        dtype: torch.dtype,
    ) -> tuple[Tensor, Tensor]:
        """One step of the components ``(C,)`` that are ``moving``; orientations, and how far each node turned, rad."""
        weight, force = self._weights_and_forces(orientations, shape, prior, settings, dtype)
        force *= moving[self.component]
        system = BlockLaplacian(self.arrivals, weight, shape, self.component)
        tolerances = settings.tolerance, settings.relative_tolerance
        step, is_solved = force, False
        if self.is_well_knit:
            step, is_solved = system.solve(force, system.diagonal_solve(), *tolerances)
        if not is_solved:
            approximate = factorised(self.graph, weight, shape, self.roots)
            step, _ = system.solve(force, approximate, *tolerances)
        step = (step - step[:, self.roots[self.component]]).t().double()
        turned = rotations.normalize(rotations.multiply(orientations, rotations.exp(step)))
        return turned, step.norm(dim=1)

    def _weights_and_forces(
        self, orientations: Tensor, shape: NoiseShape, prior: Tensor, settings: _Step, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor]:
        """Every edge's robust weight ``(M,)``, and the weighted residuals that pull at each node, summed ``(3, N)``."""
        graph = self.graph
        measured = self.measured if dtype == self.measured.dtype else None
        residuals = EdgeResiduals(graph, orientations.to(dtype), measured)
        at_source, at_target = (_distinct_entries(end).to(dtype) for end in (shape.at_source, shape.at_target))
        weight = torch.empty_like(prior, dtype=dtype)
        parts = stretches(slices(graph.num_edges, SLICE_EDGES, graph.device))
        # Components in rows: adding columns up by node is a dozen times as fast as adding up rows.
        forces = [at_source.new_zeros(3, graph.num_nodes) for _ in parts]

        def walk(part: int) -> None:
            for edges in parts[part]:
                source, target = graph.source[edges], graph.target[edges]
                vector = residuals.vectors(edges)
                pull = _times(at_source.index_select(1, source).add_(at_target.index_select(1, target)), vector)
                square = (vector * pull).sum(dim=0).add_(settings.smoothing**2)
                robust = settings.weigh(square).mul_(prior[edges].clamp(min=_MIN_PRIOR))
                weight[edges] = robust
                pull *= robust
                forces[part].index_add_(1, target, pull)
                forces[part].index_add_(1, source, pull.neg_())  # with alpha = -1 it takes six times as long

        for_each(walk, range(len(parts)))
        return weight, torch.stack(forces).sum(dim=0)


def _distinct_entries(matrices: Tensor) -> Tensor:
    """Symmetric matrices ``(N, 3, 3)`` → their entries xx, xy, xz, yy, yz, zz in rows, ``(6, N)``."""
    return matrices.flatten(1).t()[[0, 1, 2, 4, 5, 8]].contiguous()


def _times(entries: Tensor, vector: Tensor) -> Tensor:
    """Products ``(3, k)`` of symmetric matrices, given by :func:`_distinct_entries`, and vectors ``(3, k)``."""
    xx, xy, xz, yy, yz, zz = entries
    x, y, z = vector
    product = torch.empty_like(vector)
    torch.mul(xx, x, out=product[0]).addcmul_(xy, y).addcmul_(xz, z)
    torch.mul(xy, x, out=product[1]).addcmul_(yy, y).addcmul_(yz, z)
    torch.mul(xz, x, out=product[2]).addcmul_(yz, y).addcmul_(zz, z)
    return product


def _evenly_spread(group: Tensor, num_groups: int) -> Tensor:
    """Indices of members, evenly spread, at most about :data:`_MAX_SAMPLE` of each group ``(M,)``."""
    if num_groups == 1:
        return torch.arange(0, len(group), 1 + (len(group) - 1) // _MAX_SAMPLE, device=group.device)
    order = group.sort(stable=True).indices
    count = torch.bincount(group, minlength=num_groups)
    ordered = group[order]
    rank = torch.arange(len(group), device=group.device) - (count.cumsum(0) - count)[ordered]
    stride = (count + _MAX_SAMPLE - 1).div(_MAX_SAMPLE, rounding_mode="floor")[ordered]
    return order[rank % stride == 0]
