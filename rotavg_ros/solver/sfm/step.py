"""One least-squares step of the SfM refinement: residuals, robust weights, and the system that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import SLICE_EDGES, EdgeResiduals, measured_rows
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.threads import for_each, slices, stretches
from rotavg_ros.solver.sfm.block_laplacian import Arrivals, BlockLaplacian, factorised
from rotavg_ros.solver.sfm.noise_shape import NoiseShape, ResidualSample, ShapeEstimator
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Structure:
    """What is known of a graph's connections (N nodes in C components).

    Attributes:
        component: ``(N,)`` connected components.
        roots: ``(C,)`` a node of each, in the components' order; they are held fixed.
        edges: the graph's edges sorted.
    """

    component: Tensor
    roots: Tensor
    edges: SortedEdges

    @classmethod
    def of(cls, graph: ViewGraph) -> Structure:
        """Computed; a component's root is its first node."""
        component = graph.components()
        nodes = torch.arange(graph.num_nodes, device=graph.device)
        roots = nodes.new_full((int(component.max()) + 1,), graph.num_nodes)
        return cls(component, roots.scatter_reduce(0, component, nodes, "amin"), SortedEdges.of(graph))


class Measure(NamedTuple):
    """How residuals are measured and weighed.

    Attributes:
        shape: of the noise.
        variance: ``(N,)`` of the nodes, in units of the shape; numerical floors apart.
        weigh: expected squared residuals → robust weights.
        dtype: how exactly residuals and systems are computed.
    """

    shape: NoiseShape
    variance: Tensor
    weigh: Callable[[Tensor], Tensor]
    dtype: torch.dtype

    def at_ends(self, dtype: torch.dtype) -> list[Tensor]:
        """What is said of an edge at its source and at its target: six entries of the shape, variance; ``(7, N)``."""
        ends = (self.shape.at_source, self.shape.at_target)
        return [torch.cat((_distinct_entries(end), self.variance[None])).to(dtype) for end in ends]


class Step(NamedTuple):
    """One step.

    Attributes:
        turn: ``(3, N)`` radians, world's frame.
        weight: ``(N,)`` of all edges of each node.
        decrement: ``(C,)`` xᵀ L x.
    """

    turn: Tensor
    weight: Tensor
    decrement: Tensor


class Problem:
    """What stays the same from step to step, of a graph of C components."""

    def __init__(self, graph: ViewGraph, structure: Structure, priors: RefinementPriors) -> None:
        self.graph, self.priors = graph, priors
        self.roots, self.component = structure.roots, structure.component
        self.degree = structure.edges.degree
        self.arrivals = Arrivals(structure.edges)
        self.round = NoiseShape.round(graph.num_nodes, graph.device)
        self.is_well_knit = 2 * graph.num_edges >= priors.well_knit_degree * graph.num_nodes
        self.num_nodes = torch.bincount(self.component, minlength=len(self.roots))
        of_edge = self.component[graph.source]
        redundancy = torch.bincount(of_edge, minlength=len(self.roots)) - self.num_nodes + 1
        self.shapes = ShapeEstimator(self.component, redundancy, priors.shape)
        self._chosen = _evenly_spread(of_edge, len(self.roots), priors.max_sample)
        self._some = graph.select_edges(self._chosen)
        self._component_of_some = self.component[self._some.source]
        self._count_of_some = torch.bincount(self._component_of_some, minlength=len(self.roots)).clamp(min=1)
        self._measured = measured_rows(graph.target_from_source, torch.float32)

    def mean(self, value: Tensor) -> Tensor:
        """Means ``(C,)`` of the nodes' values ``(N,)``."""
        return self.sum(value) / self.num_nodes

    def sum(self, value: Tensor) -> Tensor:
        """Sums ``(C,)`` of the nodes' values ``(N,)``."""
        return value.new_zeros(len(self.roots)).index_add_(0, self.component, value)

    def largest(self, value: Tensor) -> Tensor:
        """Maxima ``(C,)`` of the nodes' values ``(N,)``, which are not negative."""
        return value.new_zeros(len(self.roots)).scatter_reduce(0, self.component, value, "amax")

    def evenly(self, value: float) -> Tensor:
        """The value for every node, ``(N,)``."""
        return torch.full((self.graph.num_nodes,), value, dtype=torch.float64, device=self.graph.device)

    def variance_of_means(self) -> Tensor:
        """Variances ``(N,)`` of nodes whose edges all weigh one: three axes of unit variance each over the degree."""
        return 3 / self.degree.clamp(min=1).double()

    def sample(self, orientations: Tensor) -> ResidualSample:
        """Residuals of some edges."""
        vector = EdgeResiduals(self._some, orientations).vectors(slice(0, self._some.num_edges))
        return ResidualSample(vector, self._some.source, self._some.target)

    def typical(self, sample: ResidualSample) -> Tensor:
        """Geometric mean of some residuals' lengths in each component, ``(C,)`` rad."""
        least = self.priors.least_residual
        logarithm = _dot(sample.vector, sample.vector).clamp(min=least**2).log() / 2
        return torch.exp(self._sum_of_some(logarithm) / self._count_of_some)

    def dispersion(self, sample: ResidualSample, measure: Measure, prior: Tensor) -> Tensor:
        """φ of each component, ``(C,)``, as some residuals have it."""
        at_source, at_target = measure.at_ends(torch.float64)
        both = at_source.index_select(1, sample.source) + at_target.index_select(1, sample.target)
        square = _dot(sample.vector, _times(both[:6], sample.vector))
        weight = measure.weigh(square + both[6]) * prior[self._chosen]
        return self._sum_of_some(weight * weight * square) / self._sum_of_some(weight)

    def _sum_of_some(self, value: Tensor) -> Tensor:
        """Sums ``(C,)`` of some edges' values ``(K,)``."""
        return value.new_zeros(len(self.roots)).index_add_(0, self._component_of_some, value)

    def step(self, orientations: Tensor, measure: Measure, prior: Tensor, is_open: Tensor) -> Step:
        """The least-squares step of the components ``(C,)`` that are open; the others' is zero."""
        weight, force = self._weights_and_forces(orientations, measure, prior)
        force *= is_open[self.component]
        system = BlockLaplacian(self.arrivals, weight, measure.shape, self.component)
        tolerances = self.priors.least_angle, self.priors.step_tolerance
        turn, is_solved = force, False
        if self.is_well_knit:
            turn, is_solved = system.solve(force, system.diagonal_solve(), *tolerances)
            self.is_well_knit = is_solved
        if not is_solved:
            approximate = factorised(self.graph, weight, measure.shape, self.roots)
            turn, _ = system.solve(force, approximate, *tolerances)
        decrement = (force * turn).sum(dim=0).double()
        turn = (turn - turn[:, self.roots[self.component]]).double()
        return Step(turn, system.weight_sum.double(), self.sum(decrement))

    def _weights_and_forces(self, orientations: Tensor, measure: Measure, prior: Tensor) -> tuple[Tensor, Tensor]:
        """Every edge's robust weight ``(M,)``, and the weighted residuals that pull at each node, summed ``(3, N)``."""
        graph, dtype = self.graph, measure.dtype
        measured = self._measured if dtype == self._measured.dtype else None
        residuals = EdgeResiduals(graph, orientations.to(dtype), measured)
        at_source, at_target = measure.at_ends(dtype)
        prior = prior.to(dtype)
        weight = torch.empty_like(prior)
        parts = stretches(slices(graph.num_edges, SLICE_EDGES, graph.device))
        # Components in rows: adding columns up by node is a dozen times as fast as adding up rows.
        forces = [at_source.new_zeros(3, graph.num_nodes) for _ in parts]

        def walk(part: int) -> None:
            for edges in parts[part]:
                source, target = graph.source[edges], graph.target[edges]
                vector = residuals.vectors(edges)
                both = at_source.index_select(1, source).add_(at_target.index_select(1, target))
                pull = _times(both[:6], vector)
                square = _dot(vector, pull).add_(both[6])
                robust = measure.weigh(square).mul_(prior[edges])
                weight[edges] = robust
                pull *= robust
                forces[part].index_add_(1, target, pull)
                forces[part].index_add_(1, source, pull.neg_())  # with alpha = -1 it takes six times as long

        for_each(walk, range(len(parts)))
        return weight, torch.stack(forces).sum(dim=0)


def l1_weight(squared_residual: Tensor) -> Tensor:
    """Weight of the ℓ1 cost, of squared residuals s = |r|²: s^(−1/2) = |r|⁻¹."""
    return squared_residual.rsqrt()


def l_half_weight(squared_residual: Tensor) -> Tensor:
    """Weight of the ℓ½ cost, of squared residuals s = |r|²: s^(−3/4) = |r|^(−3/2).

    Two roots take a fifth of the time of a power.
    """
    return (squared_residual * squared_residual.sqrt()).rsqrt_()


def _distinct_entries(matrices: Tensor) -> Tensor:
    """Symmetric matrices ``(3, 3, N)`` → their entries xx, xy, xz, yy, yz, zz in rows, ``(6, N)``."""
    return matrices.flatten(0, 1)[[0, 1, 2, 4, 5, 8]]


def _times(entries: Tensor, vector: Tensor) -> Tensor:
    """Products ``(3, k)`` of symmetric matrices, given by :func:`_distinct_entries`, and vectors ``(3, k)``."""
    xx, xy, xz, yy, yz, zz = entries
    x, y, z = vector
    product = torch.empty_like(vector)
    torch.mul(xx, x, out=product[0]).addcmul_(xy, y).addcmul_(xz, z)
    torch.mul(xy, x, out=product[1]).addcmul_(yy, y).addcmul_(yz, z)
    torch.mul(xz, x, out=product[2]).addcmul_(yz, y).addcmul_(zz, z)
    return product


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products ``(k,)`` of columns ``(3, k)``, a third faster than a sum over rows."""
    return torch.mul(a[0], b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def _evenly_spread(group: Tensor, num_groups: int, largest: int) -> Tensor:
    """Indices of members, evenly spread, at most about ``largest`` of each group ``(M,)``."""
    if num_groups == 1:
        return torch.arange(0, len(group), 1 + (len(group) - 1) // largest, device=group.device)
    order = group.sort(stable=True).indices
    count = torch.bincount(group, minlength=num_groups)
    ordered = group[order]
    rank = torch.arange(len(group), device=group.device) - (count.cumsum(0) - count)[ordered]
    stride = (count + largest - 1).div(largest, rounding_mode="floor")[ordered]
    return order[rank % stride == 0]
