"""The view-graph of one solve: nodes are camera or keyframe orientations, edges are measured relative rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from rotavg_ros.errors import UserError

ArrayLike = Tensor | np.ndarray | Sequence[Any]

# A quaternion whose norm is farther than this from one is refused rather than normalised.
UNIT_NORM_TOLERANCE = 1e-3


class EdgeKind(IntEnum):
    """What measured an edge."""

    ODOMETRY = 0
    LOOP_CLOSURE = 1


class EdgeLabel(IntEnum):
    """A verdict on an edge from outside the solver."""

    AUTOMATIC = 0
    ACCEPTED = 1
    REJECTED = 2


class ViewGraphError(UserError):
    """The arrays do not make a view-graph; the message names the first offending edge."""


@dataclass(frozen=True)
class ViewGraph:
    """Relative rotations between ``num_nodes`` orientations. Build it with :meth:`create`.

    Attributes (N nodes, M edges; all tensors on one device):
        num_nodes: N. Nodes are 0 … N-1.
        source, target: ``(M,)`` int64, the edge's ends.
        target_from_source: ``(M, 4)`` float64 xyzw, w ≥ 0: measured ``R_target R_source⁻¹`` of the
            body-from-world orientations.
        kind: ``(M,)`` int64 :class:`EdgeKind`.
        precision: ``(M,)`` float64, 1/variance of the rotation vector's components in rad⁻²; NaN where unknown.
        label: ``(M,)`` int64 :class:`EdgeLabel`.
        steps: ``(M,)`` float64, odometry steps that an odometry edge stands for: its variance in units of one. 1 but
            for edges that several were drawn together into; of loop closures without meaning.
    """

    num_nodes: int
    source: Tensor
    target: Tensor
    target_from_source: Tensor
    kind: Tensor
    precision: Tensor
    label: Tensor
    steps: Tensor

    @classmethod
    def create(
        cls,
        source: ArrayLike,
        target: ArrayLike,
        target_from_source: ArrayLike,
        *,
        num_nodes: int | None = None,
        kind: ArrayLike | None = None,
        precision: ArrayLike | None = None,
        label: ArrayLike | None = None,
        steps: ArrayLike | None = None,
    ) -> ViewGraph:
        """Check the arrays and bring them into the graph's types.

        Args:
            source, target: ``(M,)`` node indices from 0.
            target_from_source: ``(M, 4)`` xyzw.
            num_nodes: default: the largest index that occurs plus one.
            kind: default: every edge is a loop closure (an SfM view-graph).
            precision: rad⁻²; default: unknown. Values that are not positive and finite count as unknown.
            label: default: automatic.
            steps: default: 1.

        Raises:
            ViewGraphError: shapes that do not fit, an index out of range, a self-edge, steps that are not positive and
                finite, or a quaternion that is not finite or is farther than 1e-3 from unit length.
        """
        source = _as_tensor(source, torch.int64)
        target = _as_tensor(target, torch.int64)
        num_edges = len(source)
        quaternions = _as_tensor(target_from_source, torch.float64).reshape(-1, 4)
        kind = _default(kind, torch.int64, num_edges, EdgeKind.LOOP_CLOSURE)
        precision = _default(precision, torch.float64, num_edges, float("nan"))
        label = _default(label, torch.int64, num_edges, EdgeLabel.AUTOMATIC)
        steps = _default(steps, torch.float64, num_edges, 1.0)
        for name, values in (
            ("target", target),
            ("target_from_source", quaternions),
            ("kind", kind),
            ("precision", precision),
            ("label", label),
            ("steps", steps),
        ):
            if len(values) != num_edges:
                raise ViewGraphError(f"{name} has {len(values)} rows, source has {num_edges}; they must agree")
        if num_nodes is None:
            num_nodes = int(torch.maximum(source.max(), target.max())) + 1 if num_edges else 0
        ends = torch.stack((source, target))
        _refuse((ends < 0) | (ends >= num_nodes), f"a node index outside 0 … {num_nodes - 1}")
        _refuse((source == target)[None], "the same source and target")
        _refuse(~(torch.isfinite(steps) & (steps > 0))[None], "steps that are not positive and finite")
        norm = quaternions.norm(dim=1)
        _refuse(~((norm - 1).abs() <= UNIT_NORM_TOLERANCE)[None], "a quaternion that is not of unit length")
        # One product, one new array: at millions of edges its pages cost more than the arithmetic.
        quaternions = quaternions * torch.where(quaternions[:, 3] < 0, -1 / norm, 1 / norm)[:, None]
        precision = torch.where(torch.isfinite(precision) & (precision > 0), precision, torch.nan)
        return cls(num_nodes, source, target, quaternions, kind, precision, label, steps)

    @property
    def num_edges(self) -> int:
        return len(self.source)

    @property
    def device(self) -> torch.device:
        return self.source.device

    @property
    def is_odometry(self) -> Tensor:
        """``(M,)`` bool."""
        return self.kind == EdgeKind.ODOMETRY

    def to(self, device: torch.device | str) -> ViewGraph:
        """The same graph on another device; itself if it is there."""
        if self.device == torch.device(device):
            return self
        moved = {f.name: getattr(self, f.name).to(device) for f in fields(self) if f.name != "num_nodes"}
        return replace(self, **moved)

    def select_edges(self, edges: Tensor) -> ViewGraph:
        """The graph of all nodes and the edges chosen by a mask or by indices, in that order."""
        chosen = {f.name: getattr(self, f.name)[edges] for f in fields(self) if f.name != "num_nodes"}
        return replace(self, **chosen)

    def components(self, edges: Tensor | None = None) -> Tensor:
        """Connected component of every node, ``(N,)`` int64, numbered by their first node.

        Args:
            edges: ``(M,)`` mask of the edges that connect; default all.
        """
        if edges is not None:
            return self.select_edges(edges)._components
        return self._components

    @cached_property
    def _components(self) -> Tensor:
        source, target = (end.cpu().int().numpy() for end in (self.source, self.target))
        # Transposing a matrix with one entry in every row, here an edge's target in the column of its source, sorts by
        # counting; scipy's own conversion takes longer than the search.
        edge = np.arange(len(source) + 1, dtype=np.int32)
        by_source = csr_array((target, source, edge), shape=(len(source), self.num_nodes)).tocsc()
        ones = np.ones(len(source))
        adjacency = csr_array((ones, by_source.data, by_source.indptr), shape=(self.num_nodes, self.num_nodes))
        _, labels = connected_components(adjacency, directed=False)
        # scipy numbers components in the order of a traversal; ours follow the nodes' order.
        _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
        rank = np.empty(len(first), dtype=np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        return torch.from_numpy(rank[inverse]).to(self.device)


def _as_tensor(values: ArrayLike, dtype: torch.dtype) -> Tensor:
    if isinstance(values, Tensor):
        return values.to(dtype)
    return torch.from_numpy(np.array(values, dtype=str(dtype).removeprefix("torch.")))


def _default(values: ArrayLike | None, dtype: torch.dtype, length: int, fill: float) -> Tensor:
    return torch.full((length,), fill, dtype=dtype) if values is None else _as_tensor(values, dtype)


def _refuse(bad: Tensor, what: str) -> None:
    """Raise for the first edge (second dimension of ``bad``) that is marked."""
    bad_edges = bad.any(dim=0)
    if bool(bad_edges.any()):
        raise ViewGraphError(f"edge {int(bad_edges.nonzero()[0])} has {what}")
