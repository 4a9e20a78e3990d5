"""Training data of FineNet: graphs after CleanNet and the tree, computed once since they do not change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import SyntheticGraph
from rotavg_ros.metrics.orientations import gauge_alignment, orientation_errors
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.fine_net import FineNet, edge_features
from rotavg_ros.solver.neurora.message_passing import DirectedEdges
from rotavg_ros.solver.neurora.stages import clean
from rotavg_ros.solver.neurora.tiled.networks import typical_size
from rotavg_ros.solver.neurora.tree import bootstrap


class Started(Protocol):
    """A graph at the start of a FineNet: CleanNet's output, orientations ``(N, 4)``, and the truth in their gauge."""

    @property
    def cleaned(self) -> Cleaned: ...
    @property
    def start(self) -> Tensor: ...
    @property
    def truth(self) -> Tensor: ...


def validated(graphs: Iterable[Started], fine_tune: Callable[[Cleaned, Tensor], Tensor]) -> dict[str, float]:
    """Mean and median errors, degrees, of the start and after one and two passes of FineNet, and the objective."""
    rows = []
    for graph in graphs:
        errors, estimate = [orientation_errors(graph.start, graph.truth)], graph.start
        for _ in range(2):
            estimate = fine_tune(graph.cleaned, estimate)
            errors.append(orientation_errors(estimate, graph.truth))
        rows.append([float(torch.rad2deg(f(e))) for e in errors for f in (torch.mean, torch.median)])
    names = ("tree_mean_deg", "tree_median_deg", "mean_deg", "median_deg", "v2_mean_deg", "v2_median_deg")
    figures = dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))
    return {"objective": figures["mean_deg"] + figures["median_deg"], **figures}


@dataclass(frozen=True)
class StartedGraph:
    """A graph at the start of FineNet (N nodes).

    Attributes:
        cleaned: CleanNet's output.
        start: ``(N, 4)`` float64, the tree's orientations.
        truth: ``(N, 4)`` float64, in the gauge of ``start``.
    """

    cleaned: Cleaned
    start: Tensor
    truth: Tensor

    @classmethod
    def of(cls, clean_net: CleanNet, graph: SyntheticGraph) -> StartedGraph:
        begun = bootstrap(clean(clean_net, graph.graph))
        start = begun.body_from_world
        truth = rotations.multiply(graph.body_from_world, gauge_alignment(start, graph.body_from_world))
        return cls(begun.cleaned, start, truth)


@dataclass(frozen=True)
class FineBatch:
    """Several graphs as one disjoint graph of its inlier edges (float32; N nodes, M edges in all).

    Attributes:
        source, target: ``(M,)``.
        measured, rectified: ``(M, 4)`` target_from_source before and after CleanNet.
        outlier_logit: ``(M,)``.
        start, truth: ``(N, 4)`` body_from_world.
        graph: ``(N,)`` index of every node's graph.
        edges: both directions of the edges.
    """

    source: Tensor
    target: Tensor
    measured: Tensor
    rectified: Tensor
    outlier_logit: Tensor
    start: Tensor
    truth: Tensor
    graph: Tensor
    edges: DirectedEdges

    @classmethod
    def of(cls, graphs: Sequence[StartedGraph], edge_dropout: float, rng: np.random.Generator) -> FineBatch:
        """Every graph loses a share of ``edge_dropout`` of its inlier edges at random."""
        sizes = [len(graph.start) for graph in graphs]
        offsets = np.concatenate(([0], np.cumsum(sizes)))
        columns: list[list[Tensor]] = [[] for _ in range(5)]
        for graph, offset in zip(graphs, offsets[:-1].tolist(), strict=True):
            cleaned = graph.cleaned
            kept = cleaned.is_inlier.nonzero().squeeze(1)
            kept = kept[torch.from_numpy(rng.random(len(kept)) >= edge_dropout)]
            for column, value in zip(
                columns,
                (
                    cleaned.measured.source[kept] + offset,
                    cleaned.measured.target[kept] + offset,
                    cleaned.measured.target_from_source[kept].float(),
                    cleaned.graph.target_from_source[kept].float(),
                    cleaned.outlier_probability[kept].logit(),
                ),
                strict=True,
            ):
                column.append(value)
        source, target, measured, rectified, logit = (torch.cat(column) for column in columns)
        return cls(
            source,
            target,
            measured,
            rectified,
            logit,
            torch.cat([graph.start for graph in graphs]).float(),
            torch.cat([graph.truth for graph in graphs]).float(),
            torch.arange(len(graphs)).repeat_interleave(torch.tensor(sizes)),
            DirectedEdges.of(source, target, int(offsets[-1])),
        )

    def to(self, device: torch.device) -> FineBatch:
        """The same on another device."""
        edges = DirectedEdges(*(getattr(self.edges, n).to(device) for n in ("source", "target", "inverse_degree")))
        moved = {name: value.to(device) for name, value in vars(self).items() if name != "edges"}
        return FineBatch(**moved, edges=edges)

    def fine_tune(self, network: FineNet, body_from_world: Tensor) -> tuple[Tensor, Tensor]:
        """One pass of ``network`` from ``body_from_world`` ``(N, 4)``; returns the result and the scale ``(N, 1)``."""
        with torch.no_grad():
            raw, clean = (
                rotations.canonical(edge_residual(body_from_world, relative, self.source, self.target)).t()[:3]
                for relative in (self.measured, self.rectified)
            )
            scale = typical_size(raw, self.source, self.graph).expand(len(self.start), 1)
            features = edge_features(raw, clean, self.outlier_logit, scale[self.source, 0]).t()
        return network(body_from_world, features, scale, self.edges), scale
