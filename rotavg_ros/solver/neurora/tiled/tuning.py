"""The size of tiles and the number of threads of message passing on this machine: measured once, in about 100 ms."""

from __future__ import annotations

import threading
import time

import torch

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.neurora.message_passing import HIDDEN_WIDTH, MessagePassingNetwork
from rotavg_ros.solver.neurora.tiled import passes as inference
from rotavg_ros.solver.neurora.tiled.passes import Tuning
from rotavg_ros.solver.running.threads import num_workers, workers
from rotavg_ros.view_graph import ViewGraph

# Half a core's second-level cache, up to several times that.
_TILE_SIZES = (4096, 8192, 16384)
_NODES, _EDGES, _LAYERS, _REPEATS = 500, 40_000, 2, 3
_CLEARLY = 1.2
_lock = threading.Lock()
_tuned = False


def tune() -> Tuning:
    """Measure, unless this process has done so; from now on, inference uses what was fastest."""
    global _tuned
    with _lock, workers():
        if not _tuned:
            inference.set_tuning(measure())
            _tuned = True
    return inference.current_tuning()


@torch.no_grad()
def measure(num_edges: int = _EDGES) -> Tuning:
    """The fastest tuning on a random graph of ``num_edges``, within the workers; sets passes to the last one tried."""
    generator = torch.Generator().manual_seed(0)
    source = torch.randint(_NODES, (num_edges,), generator=generator)
    target = (source + torch.randint(1, _NODES, (num_edges,), generator=generator)) % _NODES
    features = rotations.random(num_edges, dtype=torch.float32, generator=generator)
    edges = SortedEdges.of(ViewGraph.create(source, target, features, num_nodes=_NODES))
    nodes = torch.zeros(_NODES, HIDDEN_WIDTH)
    network = MessagePassingNetwork(HIDDEN_WIDTH, features.shape[1], num_layers=_LAYERS)

    def seconds(tuning: Tuning) -> float:
        inference.set_tuning(tuning)
        best = float("inf")
        for _ in range(_REPEATS):
            start = time.perf_counter()
            inference.node_states(network, nodes, features, edges)
            best = min(best, time.perf_counter() - start)
        return best

    everyone = num_workers()
    tile = min(_TILE_SIZES, key=lambda size: seconds(Tuning(size, everyone)))
    # One thread is chosen only if it is 1.2 times as fast; load disturbs the measurement.
    alone = seconds(Tuning(tile, 1)) * _CLEARLY < seconds(Tuning(tile, everyone))
    return Tuning(tile, 1 if alone else everyone)
