"""Which nodes of a graph to turn together: minimum cuts, and a quick bound on what they could gain.

An edge has a cost if only one of its ends turns; the cost is negative if that repairs the edge. The best set of nodes
is a minimum cut. Most questions have the answer "none", and an electrical flow often proves it. By weak duality, a flow
is a certificate if it carries the gains of the repaired edges from end to end and stays within the losses of all
others. One factorisation gives such flows for all questions at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from rotavg_ros.solver.algebra.sparse.laplacian import FactorisedLaplacian

# SciPy's maximum flow has integer capacities: this many to a unit of cost.
_UNIT = 1000.0
# Numbers that fit into a core's cache.
_ENTRIES_AT_ONCE = 32_768


@dataclass(frozen=True)
class TwoLabels:
    """Q questions about one graph of N nodes and E edges: which nodes to turn.

    Attributes:
        num_nodes: N.
        source, target: ``(E,)``.
        to_target, to_source: ``(E, Q)`` ≥ 0, what an edge costs if only its target turns, or only its source, in
            addition to ``supply``.
        supply: ``(N, Q)`` what turning a node costs, or gains where it is negative.
        gain: ``(Q,)`` upper bound of what all edges together gain.
    """

    num_nodes: int
    source: np.ndarray
    target: np.ndarray
    to_target: np.ndarray
    to_source: np.ndarray
    supply: np.ndarray
    gain: np.ndarray

    @staticmethod
    def create(
        num_nodes: int, source: np.ndarray, target: np.ndarray, if_target: np.ndarray, if_source: np.ndarray
    ) -> TwoLabels:
        """From the costs of edges if only their target turns, or only their source, relative to neither ``(E, Q)``.

        A minimum cut requires that the two sum to at least zero. Where they do not, the larger one is raised, so the
        stated gain of a set of nodes is a lower bound. Both arrays are overwritten.
        """
        count = if_target.shape[1]
        gains = np.flatnonzero((if_target < 0) | (if_source < 0))
        edge, question = np.divmod(gains, count)
        target_turns, source_turns = if_target.take(gains), if_source.take(gains)
        # The gain of turning one end is assigned to that node. Turning the other end loses as much, which the arc
        # accounts for.
        is_target = target_turns < source_turns
        rest = np.maximum(target_turns + source_turns, 0)
        if_target.put(gains, np.where(is_target, 0.0, rest))
        if_source.put(gains, np.where(is_target, rest, 0.0))
        net = np.where(is_target, -target_turns, source_turns)
        supply = np.bincount(source[edge] * count + question, net, num_nodes * count)
        supply -= np.bincount(target[edge] * count + question, net, num_nodes * count)
        gain = np.bincount(question, np.abs(net), count)
        return TwoLabels(num_nodes, source, target, if_target, if_source, supply.reshape(num_nodes, count), gain)

    def gain_bounds(self, system: FactorisedLaplacian) -> np.ndarray:
        """Upper bounds ``(Q,)`` of the gain of turning nodes: the electrical flow in excess of the capacities.

        Args:
            system: the graph's Laplacian with any weights; the closer to the capacities, the tighter the bound.
        """
        potential = system.solve(self.supply)
        excess = np.zeros(len(self.gain))
        block = max(1, _ENTRIES_AT_ONCE // max(len(self.gain), 1))
        for start in range(0, len(self.source), block):
            edges = slice(start, start + block)
            flow = potential.take(self.source[edges], axis=0)
            flow -= potential.take(self.target[edges], axis=0)
            flow *= system.weight[edges, None]
            room = np.where(flow > 0, self.to_target[edges], self.to_source[edges])
            excess += np.maximum(np.abs(flow, out=flow) - room, 0).sum(axis=0)
        return np.asarray(np.minimum(excess, self.gain))

    def best_set(self, network: FlowNetwork, system: FactorisedLaplacian, question: int = 0) -> np.ndarray:
        """``(N,)`` bool, the nodes to turn; ``network`` is the graph's, ``system`` as in :meth:`gain_bounds`.

        The electrical flow, clipped to the capacities, is subtracted first. The costs of all sets still differ by as
        much, since residual capacities write the same cost in another way, and little is left for the maximum flow.
        """
        forwards, backwards = self.to_target[:, question], self.to_source[:, question]
        potential = system.solve(self.supply[:, [question]])[:, 0]
        flow = np.clip(system.weight * (potential[self.source] - potential[self.target]), -backwards, forwards)
        supply = self.supply[:, question] - np.bincount(self.source, flow, self.num_nodes)
        supply += np.bincount(self.target, flow, self.num_nodes)
        return network.minimum_cut(forwards - flow, backwards + flow, supply)


class FlowNetwork:
    """A graph laid out for repeated maximum flows: every edge in both directions, and terminal arcs at every node.

    Args:
        num_nodes: N.
        source, target: ``(E,)``.
    """

    def __init__(self, num_nodes: int, source: np.ndarray, target: np.ndarray) -> None:
        self._num_nodes, self._size = num_nodes, num_nodes + 2
        node = np.arange(num_nodes)
        stays, turns = np.full(num_nodes, num_nodes), np.full(num_nodes, num_nodes + 1)
        begin = np.concatenate((source, target, stays, node, node, turns))
        end = np.concatenate((target, source, node, stays, turns, node))
        arcs, slot = np.unique(begin * self._size + end, return_inverse=True)
        begin, end = np.divmod(arcs, self._size)
        self._end, self._reverse = end, np.searchsorted(arcs, end * self._size + begin)
        # Arcs back from the nodes to the one terminal, and from the other to the nodes, have no capacity.
        kinds = (len(source), len(source), num_nodes, num_nodes, num_nodes, num_nodes)
        carries = np.repeat((True, True, True, False, True, False), kinds)
        self._slot, self._first = slot[carries], np.searchsorted(begin, np.arange(self._size + 1))

    def minimum_cut(self, forwards: np.ndarray, backwards: np.ndarray, supply: np.ndarray) -> np.ndarray:
        """``(N,)`` bool, the set of nodes of least cost; of several, the largest.

        Args:
            forwards, backwards: ``(E,)`` ≥ 0, what an edge costs if only its target is in the set, or only its source.
            supply: ``(N,)`` what a node costs, or gains where it is negative.
        """
        stays, turns = self._num_nodes, self._num_nodes + 1
        values = np.concatenate((forwards, backwards, np.maximum(supply, 0), np.maximum(-supply, 0)))
        capacity = np.rint(_UNIT * np.bincount(self._slot, values, len(self._end))).astype(np.int32)
        # Both directions of every arc are present, so capacities and flows have the same layout.
        chosen = np.flatnonzero(capacity + capacity.take(self._reverse))
        network = self._matrix(chosen, capacity[chosen])
        is_open = network.data > maximum_flow(network, stays, turns).flow.data
        left = self._matrix(chosen[is_open], np.ones(int(is_open.sum()), dtype=np.int8))
        moves = np.ones(self._size, dtype=bool)
        moves[breadth_first_order(left, stays, return_predecessors=False)] = False
        return moves[: self._num_nodes]

    def _matrix(self, arcs: np.ndarray, values: np.ndarray) -> csr_array:
        """A sparse matrix with ``values`` at some of the arcs, in ascending order."""
        first = np.searchsorted(arcs, self._first).astype(np.int32)
        return csr_array((values, self._end[arcs].astype(np.int32), first), shape=(self._size, self._size))
