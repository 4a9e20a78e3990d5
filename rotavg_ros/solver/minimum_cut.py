"""Which nodes of a graph to turn together: minimum cuts, and a quick bound on what they could gain.

Every edge costs something if only one of its ends turns, less than nothing if that mends it. The best set of nodes is a
minimum cut. Most questions have the answer "none", and an electrical flow often proves it: any flow that carries what
the mended edges gain from end to end within what all the others would lose is a certificate, by weak duality, and one
factorisation gives such flows for all questions at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from rotavg_ros.solver.laplacian import FactorisedLaplacian

# scipy's maximum flow counts in integers.
_UNIT = 1000.0


@dataclass(frozen=True)
class TwoLabels:
    """Q questions about one graph of N nodes and E edges: which nodes to turn.

    Attributes:
        num_nodes: N.
        source, target: ``(E,)``.
        to_target, to_source: ``(E, Q)`` ≥ 0, what an edge costs if only its target turns, or only its source, beyond
            what ``supply`` says.
        supply: ``(N, Q)`` what turning a node costs, or gains where it is negative.
        gain: ``(Q,)`` what all edges together gain at most.
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
        """From what edges cost if only their target turns, or only their source, more than if neither does ``(E, Q)``.

        A minimum cut asks that the two add up to no less than nothing. Where they do not, the larger is raised, so that
        what a set of nodes is said to gain is what it gains at least.
        """
        raised_target = np.where(if_target < if_source, if_target, np.maximum(if_target, -if_source))
        raised_source = np.where(if_target < if_source, np.maximum(if_source, -if_target), if_source)
        # What an edge gains by turning one end is the node's; turning the other loses as much, which the arc knows.
        target_gains, source_gains = np.maximum(-raised_target, 0), np.maximum(-raised_source, 0)
        to_target = np.maximum(raised_target - source_gains, 0)
        to_source = np.maximum(raised_source - target_gains, 0)
        net = target_gains - source_gains
        supply = np.stack(
            [np.bincount(source, one, num_nodes) - np.bincount(target, one, num_nodes) for one in net.T], axis=1
        )
        return TwoLabels(num_nodes, source, target, to_target, to_source, supply, np.abs(net).sum(axis=0))

    def gain_bounds(self, system: FactorisedLaplacian) -> np.ndarray:
        """What turning nodes can gain at most ``(Q,)``: what does not fit of an electrical flow.

        Args:
            system: the graph's Laplacian with any weights; the nearer to what edges can carry, the better the bound.
        """
        potential = system.solve(self.supply)
        flow = system.weight[:, None] * (potential[self.source] - potential[self.target])
        excess = np.maximum(flow - self.to_target, 0) + np.maximum(-flow - self.to_source, 0)
        return np.asarray(np.minimum(excess.sum(axis=0), self.gain))

    def best_set(self, question: int = 0) -> np.ndarray:
        """``(N,)`` bool, the nodes to turn."""
        stays, turns = self.num_nodes, self.num_nodes + 1
        supply = self.supply[:, question]
        from_source, to_sink = np.flatnonzero(supply > 0), np.flatnonzero(supply < 0)
        begin = np.concatenate((self.source, np.full(len(from_source), stays), to_sink))
        end = np.concatenate((self.target, from_source, np.full(len(to_sink), turns)))
        none = np.zeros(len(from_source) + len(to_sink))
        forwards = np.concatenate((self.to_target[:, question], np.abs(supply[from_source]), np.abs(supply[to_sink])))
        backwards = np.concatenate((self.to_source[:, question], none))
        capacity = np.rint(_UNIT * np.concatenate((forwards, backwards))).astype(np.int32)
        arcs = (np.concatenate((begin, end)), np.concatenate((end, begin)))
        # With both directions of every arc there, capacities and flows have the same layout.
        network = csr_array(coo_array((capacity, arcs), shape=(self.num_nodes + 2,) * 2))
        left = csr_array(network - maximum_flow(network, stays, turns).flow)
        left.eliminate_zeros()
        moves = np.ones(self.num_nodes + 2, dtype=bool)
        moves[breadth_first_order(left, stays, return_predecessors=False)] = False
        return moves[: self.num_nodes]
