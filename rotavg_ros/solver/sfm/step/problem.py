"""A graph's least-squares steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.canonical_form import evenly_spread
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.sfm.laplacians.block import Arrivals, BlockLaplacian, Laplacian, factorised
from rotavg_ros.solver.sfm.laplacians.edge import EdgeLaplacian, MatrixWeights
from rotavg_ros.solver.sfm.laplacians.groups import WAYS, Group, Way
from rotavg_ros.solver.sfm.noise_density import NoiseDensity
from rotavg_ros.solver.sfm.noise_shape import NoiseShape, ResidualSample, ShapeEstimator
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.step.measure import Expected, Measure, dot
from rotavg_ros.solver.sfm.step.pull import pulled
from rotavg_ros.solver.sfm.step.structure import Structure
from rotavg_ros.solver.sfm.symmetric_rows import times
from rotavg_ros.view_graph import ViewGraph

# Groups of components change while components converge, one after the other.
_KEPT_GROUPS = 4


class Step(NamedTuple):
    """One step.

    Attributes:
        turn: ``(3, N)`` radians, world's frame.
        weight: ``(N,)`` total weight of each node's edges.
        decrement: ``(C,)`` xᵀ L x.
        source_share: ``(M,)`` probability that each edge's noise is in its source's frame.
    """

    turn: Tensor
    weight: Tensor
    decrement: Tensor
    source_share: Tensor

    def only(self, chosen: Tensor, component: Tensor) -> Step:
        """The same, but no turn where components ``(C,)`` are not chosen."""
        turn = torch.where(chosen[component], self.turn, 0.0)
        return self._replace(turn=turn, decrement=torch.where(chosen, self.decrement, 0.0))

    def but(self, chosen: Tensor, other: Step, component: Tensor, source: Tensor) -> Step:
        """The same but for the chosen components ``(C,)``, which are ``other``'s.

        Args:
            component: ``(N,)`` of every node.
            source: ``(M,)`` of the edges.
        """
        of_node = chosen[component]
        return Step(
            torch.where(of_node, other.turn, self.turn),
            torch.where(of_node, other.weight, self.weight),
            torch.where(chosen, other.decrement, self.decrement),
            torch.where(of_node[source], other.source_share, self.source_share),
        )


class Dispersion(NamedTuple):
    """Mean squares φ ``(C,)`` of each component's weighted residuals and errors, so that φ / Σ w is a node's variance.

    The answer follows its edges: an edge's squared residual is 1 − h times its squared error. h is its leverage, its
    share in the weights of its two ends, N − 1 in all.

    Attributes:
        of_residuals: Σ w² rᵀ Ω r / Σ w.
        of_errors: Σ w² rᵀ Ω r / Σ w (1 − h).
    """

    of_residuals: Tensor
    of_errors: Tensor

    def but(self, chosen: Tensor, other: Dispersion) -> Dispersion:
        """The same but for the chosen components ``(C,)``, which are ``other``'s."""
        return Dispersion(*(torch.where(chosen, *both) for both in zip(other, self, strict=True)))


class Problem:
    """What stays the same from step to step, for a graph of C components."""

    def __init__(self, graph: ViewGraph, structure: Structure, priors: RefinementPriors) -> None:
        self.graph, self.priors = graph, priors
        self.roots, self.component = structure.roots, structure.component
        self.degree, self.series = structure.edges.degree, structure.series
        self._in_series = graph.select_edges(self.series.edge)
        self._accepted, self._believed = structure.accepted, structure.accepted
        if len(self._accepted):  # the weights of those in series are by their blame
            self._believed = self._accepted[~torch.isin(self._accepted, self.series.edge)]
        self._whole = Group(graph, None, Arrivals(structure.edges), self.roots)
        self._groups: dict[bytes, Group] = {}
        self.round = NoiseShape.round(graph.num_nodes, graph.device)
        self.num_nodes = torch.bincount(self.component, minlength=len(self.roots))
        redundancy = structure.redundancy(graph)
        num_edges = redundancy + self.num_nodes - 1
        is_well_knit = 2 * num_edges >= priors.well_knit_degree * self.num_nodes
        self.is_well_knit, has_edges = np.array(torch.stack((is_well_knit, num_edges > 0)).tolist())
        # Nodes without edges need no solving; where there is nothing else, they are solved like all others.
        self._is_bare = ~has_edges & has_edges.any()
        self.shapes = ShapeEstimator(self.component, redundancy, priors.shape)
        self._chosen = evenly_spread(self.component.index_select(0, graph.source), len(self.roots), priors.max_sample)
        self._some = graph.select_edges(self._chosen)
        self._component_of_some = self.component[self._some.source]
        self._count_of_some = torch.bincount(self._component_of_some, minlength=len(self.roots)).clamp(min=1)

    def mean(self, value: Tensor) -> Tensor:
        """Means ``(C,)`` over each component of the nodes' values ``(N,)``."""
        return self.sum(value) / self.num_nodes

    def sum(self, value: Tensor) -> Tensor:
        """Sums ``(C,)`` over each component of the nodes' values ``(N,)``."""
        return value.new_zeros(len(self.roots)).index_add_(0, self.component, value)

    def largest(self, value: Tensor) -> Tensor:
        """Maxima ``(C,)`` over each component of the nodes' non-negative values ``(N,)``."""
        return value.new_zeros(len(self.roots)).scatter_reduce(0, self.component, value, "amax")

    def evenly(self, value: float) -> Tensor:
        """The value for every node, ``(N,)``."""
        return torch.full((self.graph.num_nodes,), value, dtype=torch.float64, device=self.graph.device)

    def everywhere(self, value: bool) -> np.ndarray:
        """The value for every component, ``(C,)``."""
        return np.full(len(self.roots), value)

    def variance_of_means(self) -> Tensor:
        """Variances ``(N,)`` of nodes whose edges all have weight 1: three axes of unit variance, over the degree."""
        return 3 / self.degree.clamp(min=1).double()

    def sample(self, orientations: Tensor, unit: Tensor | None = None) -> ResidualSample:
        """Residuals of some edges, in their :attr:`Measure.unit`."""
        vector = EdgeResiduals(self._some, orientations).vectors(slice(0, self._some.num_edges))
        if unit is not None:
            vector = times(unit[:, self._chosen], vector)
        return ResidualSample(vector, self._some.source, self._some.target)

    def typical(self, sample: ResidualSample) -> Tensor:
        """Geometric mean of some residuals' lengths in each component, ``(C,)`` rad."""
        least = self.priors.least_residual
        logarithm = dot(sample.vector, sample.vector).clamp(min=least**2).log() / 2
        return torch.exp(self._sum_of_some(logarithm) / self._count_of_some)

    def cost(self, orientations: Tensor, weight: Tensor) -> Tensor:
        """Σ w ‖r‖^½ of each component, ``(C,)``; weights ``(M,)``.

        An accepted edge that is no good one, as accepted edges are, costs more than all edges can.
        """
        angle = EdgeResiduals(self.graph, orientations.float()).angles()
        of_edge = self.component.index_select(0, self.graph.source)
        cost = weight.new_zeros(len(self.roots)).index_add(0, of_edge, weight * angle.sqrt())
        if len(self._accepted):
            most = weight.new_zeros(len(self.roots)).index_add(0, of_edge, weight * math.sqrt(math.pi))
            of_contradicted = of_edge[self._accepted[angle[self._accepted] > NUMBERS.outlier_angle]]
            cost = cost.index_add(0, of_contradicted, most[of_contradicted])
        return cost

    def log_likelihood(self, orientations: Tensor, weight: Tensor) -> Tensor:
        """Nats ``(C,)`` of the edges of some weight ``(M,)`` under round noise of the density that fits them best."""
        told = (weight > self.priors.density.least_prior).nonzero()[:, 0]
        angle = EdgeResiduals(self.graph, orientations.float()).angles()
        of_edge = self.component.index_select(0, self.graph.source)
        volume = torch.zeros(len(self.roots), dtype=torch.float64, device=angle.device)
        square = angle[told].double().square()
        return NoiseDensity.fitted(square, of_edge[told], of_edge, volume, self.priors.density).log_likelihood

    def pooled(self, orientations: Tensor, measure: Measure, prior: Tensor) -> Tensor:
        """Prior weights ``(M,)`` under which edges in series weigh according to their expected errors.

        Their squared residuals, and their ends' variances, give only their total error. Each edge is expected to have
        its share of the blame in it.
        """
        series = self.series
        if len(series.edge) == 0:
            return prior
        own = self._errors(self._in_series, series.edge, orientations, measure)
        expected = own.square + own.variance
        shared = (series.blame * series.sums(expected)[series.group]).clamp(min=self.priors.least_square)
        weights = (measure.weigh(square, series.edge) for square in (shared, expected))
        pooled = prior.clone()
        pooled[series.edge] *= (next(weights) / next(weights)).to(prior)
        return pooled

    def _errors(self, graph: ViewGraph, edge: Tensor, orientations: Tensor, measure: Measure) -> Expected:
        """Residuals of the edges ``edge`` ``(k,)``, given these as a graph."""
        rows = measure.rows(torch.float64)
        vector = measure.in_units(EdgeResiduals(graph, orientations).vectors(slice(0, graph.num_edges)), edge)
        return Expected.of(vector, *(rows.index_select(1, end) for end in (graph.source, graph.target)))

    def _believing(self, orientations: Tensor, measure: Measure, prior: Tensor) -> Tensor:
        """Prior weights ``(M,)`` under which no accepted edge weighs less than a good one, however far off it is.

        A node's variance is that of a mean over its edges, so those of an edge's ends tell how far edges typically err.
        """
        if len(self._believed) == 0:
            return prior
        graph = self.graph.select_edges(self._believed)
        own = self._errors(graph, self._believed, orientations, measure)
        typical = own.variance / sum(1 / self.degree[end].double() for end in (graph.source, graph.target))
        squares = (own.square.minimum(self.priors.accepted_square * typical), own.square)
        weights = (measure.weigh(square + own.variance, self._believed) for square in squares)
        believing = prior.clone()
        believing[self._believed] *= (next(weights) / next(weights)).to(prior)
        return believing

    def density(self, sample: ResidualSample, measure: Measure, prior: Tensor) -> NoiseDensity:
        """The maximum-likelihood density of sampled residuals, in their units; edges of no weight are left out."""
        expected = self._expected(sample, measure)
        square = (expected.square + expected.variance).double()
        told = prior[self._chosen] > self.priors.density.least_prior
        shape = measure.shape.information[:, :, self.roots].permute(2, 0, 1).double()
        component = self.component[self.graph.source]
        return NoiseDensity.fitted(
            square[told], self._component_of_some[told], component, shape.logdet() / 2, self.priors.density
        )

    def _expected(self, sample: ResidualSample, measure: Measure) -> Expected:
        rows = measure.rows(torch.float64)
        ends = (rows.index_select(1, end) for end in (sample.source, sample.target))
        return Expected.of(sample.vector, *ends)

    def dispersion(self, sample: ResidualSample, measure: Measure, prior: Tensor, total: Tensor | None) -> Dispersion:
        """φ of each component, from sampled residuals in their units.

        Args:
            total: ``(N,)`` total weight of each node's edges in the step before; None: all edges weigh the same.
        """
        expected = self._expected(sample, measure)
        weight = measure.weigh(expected.square + expected.variance, self._chosen) * prior[self._chosen]
        ends = (sample.source, sample.target)
        if total is None:
            shares = [1 / self.degree[end].to(weight) for end in ends]
        else:
            shares = [weight / total[end].to(weight) for end in ends]
        leverage = (1 - 1 / self.num_nodes.to(weight))[self._component_of_some] * (shares[0] + shares[1])
        square, whole = self._sum_of_some(weight * weight * expected.square), self._sum_of_some(weight)
        free = self._sum_of_some(weight * (1 - leverage).clamp(min=0))
        return Dispersion(square / whole, square / free.clamp(min=self.priors.least_prior * whole))

    def _sum_of_some(self, value: Tensor) -> Tensor:
        """Sums ``(C,)`` over each component of the sampled edges' values ``(K,)``."""
        return value.new_zeros(len(self.roots)).index_add_(0, self._component_of_some, value)

    def step(self, orientations: Tensor, measure: Measure, prior: Tensor, is_open: Tensor) -> Step:
        """The least-squares step of the open components ``(C,)``; it is zero in the others.

        Each component is solved as if it were alone, so that its answer does not depend on the others.
        """
        found: Step | None = None
        prior = self._believing(orientations, measure, prior)
        for way in WAYS:
            chosen = way.chosen(self.is_well_knit, measure.is_single)
            if not (chosen & ~self._is_bare).any():
                continue
            chosen = chosen | self._is_bare
            step, is_solved = self._solved(way, self._group(chosen), orientations, measure, prior, is_open)
            if is_solved is not None and way.is_factorised:
                step = step.only(is_solved, self.component)
            elif is_solved is not None:  # the others are factorised
                self.is_well_knit = self.is_well_knit & (np.array(is_solved.tolist()) | ~chosen)
            if found is not None:
                of_group = torch.from_numpy(chosen).to(self.component.device)
                step = found.but(of_group, step, self.component, self.graph.source)
            found = step
        assert found is not None
        return found

    def _group(self, chosen: np.ndarray) -> Group:
        """The chosen components ``(C,)``; the last few groups are kept."""
        if chosen.all():
            return self._whole
        key = chosen.tobytes()
        if key not in self._groups:
            is_node = torch.from_numpy(chosen).to(self.component.device)[self.component]
            if len(self._groups) == _KEPT_GROUPS:
                self._groups.clear()
            self._groups[key] = Group.some(self.graph, self.roots, is_node)
        return self._groups[key]

    def _solved(
        self, way: Way, group: Group, orientations: Tensor, measure: Measure, prior: Tensor, is_open: Tensor
    ) -> tuple[Step, Tensor | None]:
        """The step of a group's components, zero in the others, and where it is as good as asked for.

        That is ``(C,)`` bool; None: everywhere.
        """
        graph, measure = group.graph, measure.of(group)
        weights, matrix, force = pulled(group, orientations, measure, group.of(prior), way.dtype)
        force *= is_open[self.component]
        system: Laplacian
        if matrix is None:
            system = BlockLaplacian(group.arrivals, weights, measure.shape, self.component)
        else:
            system = EdgeLaplacian(group.arrivals, MatrixWeights(matrix, weights.total), self.component)
        if not way.is_factorised:
            approximate = system.diagonal_solve()
        elif matrix is None:
            # Cameras of a component share their noise's shape, and rotating it leaves its trace unchanged.
            trace = measure.shape.information.diagonal().sum(dim=1)[graph.source]
            approximate = factorised(graph, weights.total * trace / 3, group.fixed)
        else:
            approximate = factorised(graph, matrix[[0, 3, 5]].mean(dim=0), group.fixed)
        turn, is_solved = system.solve(force, approximate, self.priors.least_angle, self.priors.step_tolerance)
        decrement = (force * turn).sum(dim=0).double()
        turn = (turn - turn[:, self.roots[self.component]]).double()
        share = group.among_all(weights.source_share, self.graph.num_edges)
        return Step(turn, system.weight_sum.double(), self.sum(decrement), share), is_solved
