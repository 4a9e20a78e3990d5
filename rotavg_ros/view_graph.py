"""The view-graph of one solve: nodes are camera or keyframe orientations, edges are measured relative rotations."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.errors import UserError
from rotavg_ros.rotations import canonical, from_matrix, inverse, log, rotate, turn_form

ArrayLike = Tensor | np.ndarray | Sequence[Any]
_Column = TypeVar("_Column", Tensor, np.ndarray)

# A robot's loop closure is false if the error of its rotation exceeds this (degrees), or that of its translation (m).
FALSE_CLOSURE_DEG, FALSE_CLOSURE_M = 10.0, 2.0
# A quaternion is refused rather than normalised if its norm differs from one by more than this, and so is a matrix R if
# an entry of R Rᵀ differs by more than this from the identity's.
UNIT_NORM_TOLERANCE = 1e-3
# No robot drives farther between two keyframes, in whatever unit; the squares of far larger distances overflow.
MAX_TRANSLATION = 1e9
# Bounds of an odometry edge's variance in units of one step's: no more are merged, and far beyond them it overflows.
STEPS = (1e-9, 1e9)
# scipy's graph routines count nodes in 32 bits.
_MAX_NODES = 2**31 - 1
# Most nodes without an edge that the largest index may imply without `num_nodes`; more suggest that ids were passed as
# indices. One costs a solve 1.5–2.3 kB and 20 µs (measured), this many 0.2 GB and 2 s.
_MAX_IMPLIED_LONE_NODES = 100_000
# Rotations whose axes spread less than this (relative) count as all about one axis.
_PLANAR_SPREAD = 1e-10
# An information matrix counts as singular if its smallest eigenvalue is a smaller share of its largest than this.
_LEAST_EIGENVALUE = 1e-12


class EdgeKind(IntEnum):
    """The source of an edge's measurement."""

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
        steps: ``(M,)`` float64, number of odometry steps that an odometry edge stands for: its variance in units of one
            step's. 1 except for merged edges; without meaning for loop closures.
        translation: ``(M, 3)`` float64, position of the target in the source's frame, metres; NaN where unknown. None
            where no edge has one.
        information: ``(M, 3, 3)`` float64 rad⁻², symmetric positive definite: inverse covariance of the rotation vector
            e in ``target_from_source = exp(e) R_target R_source⁻¹``, an error in the target's frame; NaN where unknown.
            None where no edge has one. Only the SfM profile reads it.
        route: ``(M,)`` int64, the row of ``routes`` that says what odometry did between the ends of a merged edge; -1
            for other edges, and None if there are no routes.
        routes: ``(R, 38)`` float64, :attr:`~rotavg_ros.odometry_route.Routes.columns`.
    """

    num_nodes: int
    source: Tensor
    target: Tensor
    target_from_source: Tensor
    kind: Tensor
    precision: Tensor
    label: Tensor
    steps: Tensor
    translation: Tensor | None = None
    information: Tensor | None = None
    route: Tensor | None = None
    routes: Tensor | None = None

    @classmethod
    def create(
        cls,
        source: ArrayLike,
        target: ArrayLike,
        target_from_source: ArrayLike | None = None,
        *,
        source_from_target: ArrayLike | None = None,
        num_nodes: int | None = None,
        kind: ArrayLike | None = None,
        precision: ArrayLike | None = None,
        label: ArrayLike | None = None,
        steps: ArrayLike | None = None,
        translation: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> ViewGraph:
        """Check the arrays and bring them into the graph's types.

        Exactly one of ``target_from_source`` and ``source_from_target`` is given, as ``(M, 4)`` quaternions xyzw or as
        ``(M, 3, 3)`` rotation matrices. Of two keyframes of which the target looks 30° to the left of the source,
        ``source_from_target`` is (0, 0, 0.2588, 0.9659) and ``target_from_source`` is (0, 0, -0.2588, 0.9659).

        Args:
            source, target: ``(M,)`` integers, node indices from 0.
            target_from_source: ``R_target R_source⁻¹`` of the body-from-world orientations: takes coordinates from the
                source's frame to the target's.
            source_from_target: its inverse, the target's orientation in the source's frame: what a ROS message, a g2o
                edge or a gtsam BetweenFactor states.
            num_nodes: default: the largest index that occurs plus one.
            kind: :class:`EdgeKind` codes; default: every edge is a loop closure (an SfM view-graph).
            precision: rad⁻². Values that are not positive and finite count as unknown. Unknown ones, and the default,
                are one over the mean variance that ``information`` implies, where there is one.
            label: :class:`EdgeLabel` codes; default: automatic.
            steps: between 10⁻⁹ and 10⁹; default: 1.
            translation: ``(M, 3)`` metres, position of the target in the source's frame, the same whichever way the
                rotation is given; default: none is known. Rows that are not finite or longer than 10⁹ count as unknown.
            information: ``(M, 3, 3)`` rad⁻², of the error in the target's frame, the same whichever way the rotation is
                given; default: none is known. Matrices that are not finite and positive definite count as unknown;
                otherwise the symmetric part is used.

        Raises:
            ViewGraphError: none or both of the two rotations, arrays that are not numbers or whose shapes do not fit,
                an index out of range or far beyond the number of edges, a self-edge, an unknown code, steps beyond
                their bounds, a quaternion that is not finite or is farther than 1e-3 from unit length, or a matrix that
                is no rotation.
        """
        source = _column("source", source, torch.int64)
        num_edges = len(source)
        target = _column("target", target, torch.int64, num_edges)
        quaternions = _quaternions(target_from_source, source_from_target, num_edges)
        kind = _column("kind", kind, torch.int64, num_edges, EdgeKind.LOOP_CLOSURE)
        precision = _column("precision", precision, torch.float64, num_edges, torch.nan)
        label = _column("label", label, torch.int64, num_edges, EdgeLabel.AUTOMATIC)
        steps = _column("steps", steps, torch.float64, num_edges, 1.0)
        num_nodes = _num_nodes(source, target, num_nodes)
        _refuse(source == target, "the same source and target", source)
        _refuse((kind < 0) | (kind >= len(EdgeKind)), "kind {}; 0 is odometry, 1 a loop closure", kind)
        unknown_label = (label < 0) | (label >= len(EdgeLabel))
        _refuse(unknown_label, "label {}; 0 is automatic, 1 accepted, 2 rejected", label)
        _refuse(~are_steps(steps), f"{{:g}} steps; they must be between {STEPS[0]:g} and {STEPS[1]:g}", steps)
        precision = torch.where(torch.isfinite(precision) & (precision > 0), precision, torch.nan)
        places = None if translation is None else _translations(translation, num_edges)
        matrices = None if information is None else _informations(information, num_edges)
        if matrices is not None:
            precision = torch.where(precision.isnan(), mean_precision(matrices), precision)
        return cls(num_nodes, source, target, quaternions, kind, precision, label, steps, places, matrices)

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
        """The same graph on another device; itself if it is already there."""
        if self.device == torch.device(device):
            return self
        columns: dict[str, Any] = {name: column.to(device) for name, column in self._columns.items()}
        return replace(self, routes=None if self.routes is None else self.routes.to(device), **columns)

    def select_edges(self, edges: Tensor) -> ViewGraph:
        """The graph of all nodes and the edges chosen by a mask or by indices, in that order."""
        return replace(self, **{name: column[edges] for name, column in self._columns.items()})

    def first_edges(self, count: int, then: Tensor) -> ViewGraph:
        """The graph of all nodes, the first ``count`` edges, and after them those of these indices."""
        columns: dict[str, Any] = {
            name: torch.cat((column[:count], column[then])) for name, column in self._columns.items()
        }
        return replace(self, **columns)

    def reverse_edges(self, edges: Tensor) -> ViewGraph:
        """The same graph with some edges reversed, from their target to their source.

        Args:
            edges: ``(M,)`` mask.
        """
        turned: dict[str, Any] = {}
        if self.translation is not None:
            seen = -rotate(self.target_from_source, self.translation)
            turned["translation"] = torch.where(edges[:, None], seen, self.translation)
        if self.information is not None:
            seen = turn_form(inverse(self.target_from_source), self.information)
            turned["information"] = torch.where(edges[:, None, None], seen, self.information)
        stated = torch.where(edges[:, None], canonical(inverse(self.target_from_source)), self.target_from_source)
        source, target = (
            torch.where(edges, one, other) for one, other in ((self.target, self.source), (self.source, self.target))
        )
        return replace(self, source=source, target=target, target_from_source=stated, **turned)

    def of_routes(self, part: int | slice) -> Tensor | None:
        """``(M,)`` or ``(M, …)``, columns of ``routes`` for each edge; NaN where unknown, None if all are unknown."""
        if self.route is None or self.routes is None or len(self.routes) == 0:
            return None
        known = self.route >= 0
        rows = self.routes[self.route.clamp_min(0), part]
        return torch.where(known if rows.ndim == 1 else known[:, None], rows, torch.nan)

    @property
    def _columns(self) -> dict[str, Any]:
        """The columns that exist, by name."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in {"num_nodes", "routes"}}
        return {name: column for name, column in values.items() if column is not None}

    def components(self, edges: Tensor | None = None) -> Tensor:
        """Connected component of every node, ``(N,)`` int64, numbered by their first node.

        Args:
            edges: ``(M,)`` mask of the edges that connect; default all.
        """
        if edges is not None:
            return self.select_edges(edges)._components
        return self._components

    @cached_property
    def rotation_components(self) -> int:
        """1 if all measured rotations share one axis (planar motion), else 3; see :attr:`tells_dimension`."""
        vectors = log(self.target_from_source[self.tells_dimension])
        spread = torch.linalg.eigvalsh(vectors.T @ vectors)
        return 1 if float(spread[1]) <= _PLANAR_SPREAD * float(spread[2]) else 3

    @cached_property
    def tells_dimension(self) -> Tensor:
        """``(M,)`` bool, the edges that say whether all motion is in a plane: a user's rejected ones say nothing.

        But if these alone join some parts, one part lies by them relative to another, in any plane: then all count.
        """
        usable = self.label != EdgeLabel.REJECTED
        is_joined = bool(usable.all()) or int(self.components(usable).max()) == int(self.components().max())
        return usable if is_joined else torch.ones_like(usable)

    @cached_property
    def _components(self) -> Tensor:
        # Takes a tenth of a second to load, and may never be needed.
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import connected_components

        source, target = (end.cpu().int().numpy() for end in (self.source, self.target))
        # Transposing a matrix with one entry in every row, here an edge's target in the column of its source, sorts by
        # counting; scipy's own conversion takes longer than the search.
        edge = np.arange(len(source) + 1, dtype=np.int32)
        by_source = csr_array((target, source, edge), shape=(len(source), self.num_nodes)).tocsc()
        ones = np.ones(len(source))
        adjacency = csr_array((ones, by_source.data, by_source.indptr), shape=(self.num_nodes, self.num_nodes))
        count, labels = connected_components(adjacency, directed=False)
        # scipy numbers components in the order of a traversal; ours follow the nodes' order.
        first = np.empty(count, dtype=np.int64)
        first[labels[::-1]] = np.arange(len(labels))[::-1]  # the last assignment of a label is its first node
        rank = np.empty(count, dtype=np.int64)
        rank[np.argsort(first)] = np.arange(count)
        return torch.from_numpy(rank[labels]).to(self.device)


class HoldsViewGraph(Protocol):
    """An object with a view-graph as its ``graph``, such as the content of a file."""

    @property
    def graph(self) -> ViewGraph: ...


def view_graph_of(holder: ViewGraph | HoldsViewGraph) -> ViewGraph:
    """The view-graph itself, or the one that a file's content holds.

    Raises:
        ViewGraphError: it is neither.
    """
    graph = holder if isinstance(holder, ViewGraph) else getattr(holder, "graph", None)
    if not isinstance(graph, ViewGraph):
        what = type(holder).__name__
        raise ViewGraphError(f"a {what} is no view-graph; make one with ViewGraph.create or read one with read_graph")
    return graph


def _translations(values: ArrayLike, num_edges: int) -> Tensor:
    """``(M, 3)`` metres; rows that are not finite or implausibly long become NaN."""
    places = _as_tensor("translation", values, torch.float64)
    if places.shape != (num_edges, 3):
        raise ViewGraphError(f"translation has shape {tuple(places.shape)}; it must be ({num_edges}, 3), metres")
    return where_possible(places)


def where_possible(translation: Tensor) -> Tensor:
    """``(M, 3)``; rows with an entry that is not finite or above :data:`MAX_TRANSLATION` become NaN."""
    return torch.where((translation.abs() <= MAX_TRANSLATION).all(dim=1, keepdim=True), translation, torch.nan)


def are_steps(steps: _Column) -> _Column:
    """``(M,)`` bool, which of ``(M,)`` are within :data:`STEPS`."""
    return (steps >= STEPS[0]) & (steps <= STEPS[1])


def mean_precision(information: Tensor) -> Tensor:
    """One over the mean variance of the axes, ``(M,)`` rad⁻², of ``(M, 3, 3)``; NaN where unknown."""
    is_known = information.isfinite().all(dim=2).all(dim=1)
    unit = torch.eye(3, dtype=information.dtype, device=information.device)
    information = torch.where(is_known[:, None, None], information, unit)
    is_known &= torch.linalg.cholesky_ex(information).info == 0  # else not positive definite
    inverses = torch.linalg.inv_ex(information).inverse
    return torch.where(is_known, 3 / inverses.diagonal(dim1=1, dim2=2).sum(dim=1), torch.nan)


def _informations(values: ArrayLike, num_edges: int) -> Tensor:
    """``(M, 3, 3)`` rad⁻², symmetric; what is not finite and positive definite becomes NaN."""
    matrices = _as_tensor("information", values, torch.float64)
    if matrices.shape != (num_edges, 3, 3):
        raise ViewGraphError(
            f"information has shape {tuple(matrices.shape)}; it must be ({num_edges}, 3, 3), in the target's frame"
        )
    matrices = (matrices + matrices.mT) / 2
    scale = matrices.abs().amax(dim=(1, 2)) if num_edges else matrices.new_empty(0)
    is_finite = torch.isfinite(scale) & (scale > 0)
    unit = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
    scaled = torch.where(is_finite[:, None, None], matrices / scale[:, None, None], unit)
    eigenvalue = torch.linalg.eigvalsh(scaled)
    is_known = is_finite & (eigenvalue[:, 0] > _LEAST_EIGENVALUE * eigenvalue[:, 2])
    return torch.where(is_known[:, None, None], matrices, torch.nan)


def _quaternions(target_from_source: ArrayLike | None, source_from_target: ArrayLike | None, num_edges: int) -> Tensor:
    """``(M, 4)`` target_from_source of unit length with w ≥ 0, from the one that is given."""
    if (target_from_source is None) == (source_from_target is None):
        raise ViewGraphError(
            "give either target_from_source or source_from_target (its inverse, as ROS and g2o state it), and not both"
        )
    is_inverse = target_from_source is None
    name = "source_from_target" if is_inverse else "target_from_source"
    values = _as_tensor(name, source_from_target if is_inverse else target_from_source, torch.float64)
    if values.ndim == 3 and values.shape[1:] == (3, 3):
        identity = torch.eye(3, dtype=values.dtype, device=values.device)
        defect = (values @ values.mT - identity).abs().amax(dim=(1, 2))
        is_rotation = (defect <= UNIT_NORM_TOLERANCE) & (torch.linalg.det(values) > 0)
        _refuse(~is_rotation, f"a matrix in {name} that is not a rotation (orthonormal, determinant 1)", defect)
        values = from_matrix(values)
    elif values.ndim == 2 and values.shape[1] == 4:
        norm = values.norm(dim=1)
        is_unit = (norm - 1).abs() <= UNIT_NORM_TOLERANCE
        _refuse(~is_unit, f"a quaternion of length {{:.6g}} in {name}; it must be finite and of unit length", norm)
        # One product, one new array: at millions of edges its pages cost more than the arithmetic.
        values = values * torch.where(values[:, 3] < 0, -1 / norm, 1 / norm)[:, None]
    elif values.numel() == 0:
        values = values.reshape(0, 4)
    else:
        raise ViewGraphError(
            f"{name} has shape {tuple(values.shape)}; it must be (M, 4), quaternions xyzw, or (M, 3, 3), matrices"
        )
    _check_rows(name, values, num_edges)
    return inverse(values) if is_inverse else values


def _num_nodes(source: Tensor, target: Tensor, given: int | None) -> int:
    """Number of nodes in a graph of these edges; refuses ends beyond them."""
    smallest, largest = torch.minimum(source, target), torch.maximum(source, target)
    _refuse(smallest < 0, "node {}; node indices count from 0", smallest)
    try:
        given = None if given is None else operator.index(given)  # such as NumPy's, or a tensor's
    except TypeError:
        raise ViewGraphError(f"num_nodes is {given!r}; it must be a whole number") from None
    if given is not None and not 0 <= given <= _MAX_NODES:
        raise ViewGraphError(f"num_nodes is {given}; it must be 0 … {_MAX_NODES}")
    if given is not None:
        _refuse(largest >= given, f"node {{}}; with num_nodes {given} indices are 0 … {given - 1}", largest)
        return given
    num_nodes = int(largest.max()) + 1 if len(largest) else 0
    if num_nodes > _MAX_NODES or num_nodes - 2 * len(largest) > _MAX_IMPLIED_LONE_NODES:
        raise ViewGraphError(
            f"the largest index is {num_nodes - 1}, but there are only {len(largest)} edges; number the nodes 0 … N-1 "
            "(GraphFile.from_ids does, or numpy.unique with return_inverse), or give num_nodes"
        )
    return num_nodes


def _as_tensor(name: str, values: ArrayLike | None, dtype: torch.dtype) -> Tensor:
    """The values in that dtype, float64 or int64; copied unless they already are a tensor of it."""
    if not isinstance(values, Tensor):
        try:
            array = np.asarray(values)
        except (TypeError, ValueError):  # rows of different lengths
            raise ViewGraphError(f"{name} is not an array; its rows must have the same length") from None
        if array.size and array.dtype.kind not in "biuf":
            raise ViewGraphError(f"{name} holds {array.dtype}; it must hold numbers")
        if array.dtype == np.uint64 and array.size and array.max() > np.iinfo(np.int64).max:
            raise ViewGraphError(f"{name} holds {array.max()}, which is too large")
        values = torch.from_numpy(array.astype(np.float64 if array.dtype.kind == "f" else np.int64))
    elif values.is_complex():
        raise ViewGraphError(f"{name} holds complex numbers; it must hold real ones")
    converted = values.to(dtype)
    if dtype == torch.int64 and values.is_floating_point():
        broken = values[converted != values]
        if len(broken):
            raise ViewGraphError(f"{name} holds {broken[0].item():g}; it must hold whole numbers")
    return converted


def _column(
    name: str, values: ArrayLike | None, dtype: torch.dtype, num_edges: int | None = None, default: float = 0.0
) -> Tensor:
    """One entry per edge, ``(M,)``."""
    if values is None:
        return torch.full((num_edges or 0,), default, dtype=dtype)
    column = _as_tensor(name, values, dtype)
    if column.ndim != 1:
        raise ViewGraphError(f"{name} has shape {tuple(column.shape)}; it must be (M,), one entry per edge")
    if num_edges is not None:
        _check_rows(name, column, num_edges)
    return column


def _check_rows(name: str, values: Tensor, num_edges: int) -> None:
    if len(values) != num_edges:
        raise ViewGraphError(f"{name} has {len(values)} rows, source has {num_edges}; they must agree")


def _refuse(bad: Tensor, what: str, values: Tensor) -> None:
    """Raise for the first edge marked in ``bad`` ``(M,)``; ``{}`` in ``what`` stands for its entry of ``values``."""
    if bool(bad.any()):
        edge = int(bad.nonzero()[0])
        raise ViewGraphError(f"edge {edge} has {what.format(values[edge].item())}")
