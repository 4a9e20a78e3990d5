"""Refinement that believes the noise size and shape stated by edges as far as residuals confirm them.

1. Two exponents, α (:mod:`rotavg_ros.solver.sfm.stated.precision`) and β (:mod:`rotavg_ros.solver.sfm.stated.shape`),
   are estimated from the residuals of an answer that treats all edges alike.
2. Components in which α or β is not 0 are refined anew.
3. Where β is not 0, both are estimated once more from the residuals of the new answer, whose smaller errors hide less
   of the noise, and shaped steps continue from there. Coarse steps ignore shapes and would move away from it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.refinement import EdgeWeights
from rotavg_ros.solver.sfm.stated.precision import Residuals, relative_variance, stated_sizes
from rotavg_ros.solver.sfm.stated.shape import FramedResiduals, believed_units
from rotavg_ros.solver.sfm.step.structure import Structure
from rotavg_ros.view_graph import ViewGraph


class StatedNoise(NamedTuple):
    """What edges of a graph state about their noise (M edges, C components).

    Attributes:
        graph, structure: the graph and its connections; exponents are estimated for each component.
        size: ``(M,)`` rad⁻² of any scale, NaN where unknown.
        information: ``(M, 3, 3)`` in the targets' frames, NaN where unknown; None: only sizes are believed.
        priors: constants of the refinement.
    """

    graph: ViewGraph
    structure: Structure
    size: Tensor
    information: Tensor | None
    priors: RefinementPriors

    @classmethod
    def of(cls, graph: ViewGraph, structure: Structure, priors: RefinementPriors, with_shapes: bool) -> StatedNoise:
        """Reads what the graph states.

        Args:
            with_shapes: whether axes are believed, too.
        """
        return cls(graph, structure, stated_sizes(graph), graph.information if with_shapes else None, priors)

    def refined(
        self, orientations: Tensor, weights: EdgeWeights, refine: Callable[..., Tensor]
    ) -> tuple[Tensor, EdgeWeights]:
        """The orientations ``(N, 4)``, refined anew where statements are believed, and the edges' weights there.

        Args:
            refine: :func:`rotavg_ros.solver.sfm.refinement.refine` for this graph.
            weights: weights without statements.
        """
        if not bool(self.size.isfinite().any()):
            return orientations, weights
        ratio, unit = self._believed(orientations)
        if ratio is None and unit is None:
            return orientations, weights
        chosen = _weighed(weights, ratio, unit)
        is_believed = self._components(ratio, unit)[self.structure.component][:, None]
        orientations = torch.where(is_believed, refine(orientations, weights=chosen), orientations)
        if unit is None:
            return orientations, chosen
        has_shapes = self._components(None, unit)
        is_again = has_shapes[self.structure.component[self.graph.source]]
        ratio_again, unit_again = self._believed(orientations)
        ratio = torch.where(is_again, _or_ones(ratio_again, self.size), _or_ones(ratio, self.size))
        unit = unit if unit_again is None else torch.where(is_again, unit_again, unit)
        chosen = _weighed(weights, ratio, unit)
        shaped_only = replace(self.priors, max_coarse_steps=0)
        again = refine(orientations, weights=chosen, priors=shaped_only)
        return torch.where(has_shapes[self.structure.component][:, None], again, orientations), chosen

    def _believed(self, orientations: Tensor) -> tuple[Tensor | None, Tensor | None]:
        """ρ ``(M,)`` and T ``(3, 3, M)`` as far as residuals at the orientations confirm them; None: for no edge."""
        graph, structure = self.graph, self.structure
        component, redundancy = structure.component[graph.source], structure.redundancy(graph)
        angle = EdgeResiduals(graph, orientations.float()).angles()
        ratio = relative_variance(self.size, Residuals(angle, component, redundancy))
        if self.information is None:
            return ratio, None
        orientations = orientations.double()
        vector = EdgeResiduals(graph, orientations).vectors(slice(0, graph.num_edges)).t()
        matrix = rotations.to_matrix(orientations)
        at_source, at_target = matrix[graph.source], matrix[graph.target]
        vector = (at_target @ vector[:, :, None]).squeeze(2)
        if ratio is not None:
            vector = vector * ratio.rsqrt()[:, None]
        framed = FramedResiduals(vector, at_source @ at_target.mT, component, redundancy)
        return ratio, believed_units(self.information, framed, self.priors.shape)

    def _components(self, ratio: Tensor | None, unit: Tensor | None) -> Tensor:
        """Components in which any statement is believed, ``(C,)`` bool."""
        of_edge = torch.zeros_like(self.size, dtype=torch.bool)
        if ratio is not None:
            of_edge |= ratio != 1
        if unit is not None:
            identity = torch.eye(3, dtype=unit.dtype, device=unit.device)[:, :, None]
            of_edge |= (unit != identity).flatten(0, 1).any(dim=0)
        believed = torch.zeros_like(self.structure.roots, dtype=torch.bool)
        believed[self.structure.component[self.graph.source[of_edge]]] = True
        return believed


def _weighed(weights: EdgeWeights, ratio: Tensor | None, unit: Tensor | None) -> EdgeWeights:
    """Weights that include ρ, with residuals in units of √ρ in the costs |r|^½ and |r|, and T."""
    if ratio is not None:
        weights = weights.times(ratio**-0.25, ratio**-0.5)
    return weights._replace(unit=unit)


def _or_ones(ratio: Tensor | None, like: Tensor) -> Tensor:
    return torch.ones_like(like) if ratio is None else ratio
