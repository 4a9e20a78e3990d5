"""Spanning forests of a view-graph and the orientations composed along them.

Forests come from SciPy. Orientations are composed in float64, in log₂(depth) vectorised rounds of pointer jumping, even
along 10⁴ edges in a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, dijkstra, minimum_spanning_tree
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.pointer_jumping import doublings
from rotavg_ros.solver.algebra.residuals import multiply_rows
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class SpanningForest:
    """A rooted tree in every connected component.

    Attributes:
        parent: ``(N,)`` int64; a root is its own parent.
        parent_edge: ``(N,)`` int64, the edge between a node and its parent; -1 at roots.
        component: ``(N,)`` int64, numbered by the components' first nodes.
    """

    parent: np.ndarray
    parent_edge: np.ndarray
    component: np.ndarray

    @property
    def roots(self) -> np.ndarray:
        """Root of each component, in the components' order."""
        roots = np.flatnonzero(self.parent_edge < 0)
        return roots[np.argsort(self.component[roots])]


def shortest_path_forest(
    graph: ViewGraph,
    cost: Tensor | None = None,
    root: str | Tensor = "hub",
    *,
    edges: SortedEdges | None = None,
    component: Tensor | None = None,
) -> SpanningForest:
    """Tree of least total cost to the root of each component, by Dijkstra's algorithm (NeuRoRA §4.2).

    Where all costs are equal it is a breadth-first tree.

    Args:
        graph: on the CPU.
        cost: ``(M,)`` positive; default: 1 each.
        root: "hub", the node of highest degree, or "first", the first node of the component; or ``(C,)`` the roots.
        edges: the graph's edges sorted; default: computed.
        component: ``(N,)`` its connected components; default: computed.
    """
    edges = SortedEdges.of(graph) if edges is None else edges
    labels = (graph.components() if component is None else component).numpy()
    if isinstance(root, Tensor):
        roots = root.numpy()
    else:
        priority = -edges.degree.numpy() if root == "hub" else np.zeros(graph.num_nodes)
        roots = _first_per_component(labels, priority)
    costs = np.ones(len(edges.source)) if cost is None else cost.detach().index_select(0, edges.edge).double().numpy()
    # The matrix has both directions of every edge, and parallel edges too, which Dijkstra's algorithm allows.
    adjacency = csr_array((costs, edges.source.numpy(), edges.first.numpy()), shape=(graph.num_nodes, graph.num_nodes))
    _, parent, _ = dijkstra(adjacency, directed=True, indices=roots, return_predecessors=True, min_only=True)
    parent = np.where(parent < 0, np.arange(graph.num_nodes), parent).astype(np.int64)

    # A node's edge to its parent: the cheapest of those from there, and the first of those if several are cheapest.
    row = np.flatnonzero(edges.source.numpy() == np.repeat(parent, edges.degree.numpy()))
    child, edge = edges.target().numpy()[row], edges.edge.numpy()[row]
    order = np.lexsort((edge, costs[row], child))
    child, first = np.unique(child[order], return_index=True)
    parent_edge = np.full(graph.num_nodes, -1, dtype=np.int64)
    parent_edge[child] = edge[order][first]
    return SpanningForest(parent, parent_edge, labels)


def minimum_spanning_forest(graph: ViewGraph, cost: Tensor, is_root: NDArray[np.bool_] | None = None) -> SpanningForest:
    """Forest of least total ``cost`` ``(M,)``, rooted at each component's first node.

    Args:
        is_root: ``(N,)`` nodes that may be roots; in a component without any, the first node is; default: all.
    """
    best = _cheapest_parallel_edges(graph, cost)
    # scipy drops explicit zeros, so costs must be positive.
    positive = np.maximum(best.cost, np.finfo(np.float64).tiny)
    tree = minimum_spanning_tree(
        csr_array(coo_array((positive, (best.low, best.high)), shape=(graph.num_nodes, graph.num_nodes)))
    ).tocoo()
    ends = np.concatenate((tree.row, tree.col)), np.concatenate((tree.col, tree.row))
    adjacency = csr_array(coo_array((np.ones(2 * len(tree.row)), ends), shape=(graph.num_nodes, graph.num_nodes)))
    component = graph.components().cpu().numpy()
    roots = _first_per_component(component, np.zeros(graph.num_nodes) if is_root is None else ~is_root)
    return _forest(_breadth_first_parents(adjacency, roots), best, component, graph.num_nodes)


def compose_orientations(forest: SpanningForest, graph: ViewGraph) -> Tensor:
    """Orientations along the forest, body_from_world ``(N, 4)`` float64 on the CPU, roots at the identity."""
    child = np.flatnonzero(forest.parent_edge >= 0)
    edge = forest.parent_edge[child]
    graph = graph.to("cpu")
    rows = np.zeros((4, len(forest.parent)))
    rows[3] = 1.0
    rows[:, child] = graph.target_from_source.numpy().take(edge, axis=0).T
    leaves_child = graph.target.numpy().take(edge) != child
    rows[:3, child[leaves_child]] *= -1.0
    for ancestor, _ in doublings(forest.parent):
        rows = quaternion_rows.multiply(rows, rows.take(ancestor, axis=1))
    unit = quaternion_rows.normalize(rows) * np.where(rows[3] < 0, -1.0, 1.0)
    return torch.from_numpy(np.ascontiguousarray(unit.T))


def compose(parent: Tensor, parent_edge: Tensor, graph: ViewGraph) -> Tensor:
    """As :func:`compose_orientations`, from the forest's tensors ``(N,)``, all on the graph's device."""
    child = (parent_edge >= 0).nonzero().squeeze(1)
    edge = parent_edge[child]
    measured = graph.target_from_source[edge].double()
    enters_child = graph.target[edge] == child
    child_from_parent = torch.where(enters_child[:, None], measured, rotations.inverse(measured))
    # Invariant: node_from_ancestor[v] rotates from the frame of ancestor[v]; both double their reach every round.
    node_from_ancestor = rotations.identity(len(parent), device=parent.device)
    node_from_ancestor[child] = child_from_parent
    rows = node_from_ancestor.t().contiguous()
    for ancestor, _ in doublings(parent):
        rows = multiply_rows(rows, rows.index_select(1, ancestor))
    return rotations.normalize(rows.t().contiguous())


def accumulate_to_root(forest: SpanningForest, value: np.ndarray) -> np.ndarray:
    """Sum of ``value`` ``(N, …)`` over each node's path to its root; a node's value belongs to its parent edge."""
    total = value * (forest.parent_edge >= 0).reshape(-1, *(1,) * (value.ndim - 1))
    for ancestor, _ in doublings(forest.parent):
        total = total + total[ancestor]
    return total


@dataclass(frozen=True)
class _UndirectedEdges:
    """One edge per connected pair of nodes: the cheapest of its parallels (low < high)."""

    low: np.ndarray
    high: np.ndarray
    cost: np.ndarray
    index: np.ndarray


def _cheapest_parallel_edges(graph: ViewGraph, cost: Tensor) -> _UndirectedEdges:
    source, target = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    low, high = np.minimum(source, target), np.maximum(source, target)
    costs, pair = cost.detach().cpu().double().numpy(), low * np.int64(graph.num_nodes) + high
    order = np.argsort(pair, kind="stable")  # takes hardly any time where pairs are sorted already
    is_first = np.diff(pair[order], prepend=-1) > 0
    if not is_first.all():
        order = np.lexsort((costs, pair))
    order = order[is_first]
    return _UndirectedEdges(low[order], high[order], costs[order], order)


def _first_per_component(component: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """The node of lowest priority value in each component; of several, the earliest."""
    order = np.lexsort((np.arange(len(component)), priority, component))
    _, first = np.unique(component[order], return_index=True)
    return order[first]


def _breadth_first_parents(adjacency: csr_array, roots: np.ndarray) -> np.ndarray:
    """Parents in breadth-first trees from all roots at once, through one extra node that joins the roots."""
    num_nodes = adjacency.shape[0]
    if num_nodes == 0:
        return np.empty(0, dtype=np.int64)
    indptr = np.append(adjacency.indptr, adjacency.nnz + len(roots))
    indices = np.append(adjacency.indices, roots)
    joined = csr_array((np.ones(len(indices)), indices, indptr), shape=(num_nodes + 1, num_nodes + 1))
    _, parent = breadth_first_order(joined, num_nodes, directed=True)
    parent = parent[:num_nodes].astype(np.int64)
    return np.where(parent == num_nodes, np.arange(num_nodes), parent)


def _forest(parent: np.ndarray, edges: _UndirectedEdges, component: np.ndarray, num_nodes: int) -> SpanningForest:
    child = np.flatnonzero(parent != np.arange(num_nodes))
    low, high = np.minimum(child, parent[child]), np.maximum(child, parent[child])
    # The pairs are sorted by (low, high), so a combined key finds each child's edge.
    keys = edges.low * np.int64(num_nodes) + edges.high
    parent_edge = np.full(num_nodes, -1, dtype=np.int64)
    parent_edge[child] = edges.index[np.searchsorted(keys, low * np.int64(num_nodes) + high)]
    return SpanningForest(parent, parent_edge, component)
