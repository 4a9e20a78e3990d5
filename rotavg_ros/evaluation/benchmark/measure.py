"""Time one contender on one graph, in this process alone: ``python -m rotavg_ros.evaluation.benchmark.measure``.

Prints one line of JSON. A process of its own gives every contender the same memory and threads to start from, its own
peak memory, and nothing of what another left behind.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from rotavg_ros.evaluation.benchmark.cases import load
from rotavg_ros.evaluation.metrics import orientation_errors
from rotavg_ros.evaluation.named_peers import PEERS
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import EdgeKind, ViewGraph

# Contenders by name, and what reports call them.
LABELS = {
    "neurora": "rotavg",
    "neurora-paper": "rotavg without refinement",
    "neurora-cuda": "rotavg on a GPU",
    "colmap": "COLMAP",
    "shonan": "GTSAM Shonan",
    "gnc": "GTSAM GNC",
}
# Solves are repeated until they have taken this long.
ENOUGH_S = 15.0
OURS = frozenset({"neurora", "neurora-paper", "neurora-cuda"})


@dataclass(frozen=True)
class Measurement:
    """What came out of one process.

    Attributes:
        contender: of :data:`LABELS`.
        nodes, edges: of the graph.
        wall_seconds, cpu_seconds: of every repeat, graph in memory → answer in memory; CPU time of all threads.
        stage_seconds: wall-clock of our stages in the repeat of median wall-clock.
        mean_deg, median_deg: error of the orientations.
        peak_bytes: the process's largest resident size, interpreter, libraries and graph included.
        graph_bytes: the same before the first solve.
    """

    contender: str
    nodes: int
    edges: int
    wall_seconds: list[float]
    cpu_seconds: list[float]
    mean_deg: float
    median_deg: float
    peak_bytes: int
    graph_bytes: int
    stage_seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Run:
    body_from_world: Tensor
    wall: float
    cpu: float
    stages: dict[str, float]


def measure(path: Path, contender: str, repeats: int) -> Measurement:
    """Solve the graph in a file, after a tiny one that pays what a process pays once.

    Args:
        repeats: solves at most; there are fewer where they take more than :data:`ENOUGH_S`.
    """
    drawn = load(path)
    run = _ours(contender) if contender in OURS else _peer(contender)
    run(_triangle(odometry=bool(drawn.graph.is_odometry.any())))
    before = _peak_bytes()
    runs = [run(drawn.graph)]
    while len(runs) < repeats and sum(one.wall for one in runs) < ENOUGH_S:
        runs.append(run(drawn.graph))
    typical = sorted(runs, key=lambda one: one.wall)[len(runs) // 2]
    peak = _peak_bytes()
    error = torch.rad2deg(orientation_errors(typical.body_from_world, drawn.truth))
    return Measurement(
        contender,
        drawn.graph.num_nodes,
        drawn.graph.num_edges,
        [one.wall for one in runs],
        [one.cpu for one in runs],
        float(error.mean()),
        float(error.median()),
        peak,
        before,
        typical.stages,
    )


def _ours(contender: str) -> Callable[[ViewGraph], _Run]:
    method, _, device = contender.partition("-cuda")
    device = "cuda" if contender.endswith("-cuda") else "cpu"

    def run(graph: ViewGraph) -> _Run:
        graph = replace(graph)  # a graph remembers its components; every repeat is to find them anew
        wall, cpu = time.perf_counter(), time.process_time()
        solution = solve(graph, method=method, device=device)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        return _Run(solution.body_from_world, wall, cpu, solution.stage_seconds)

    return run


def _peer(contender: str) -> Callable[[ViewGraph], _Run]:
    def run(graph: ViewGraph) -> _Run:
        answer = PEERS[contender].solve(graph)
        return _Run(answer.body_from_world, answer.seconds, answer.cpu_seconds, {})

    return run


def _triangle(odometry: bool) -> ViewGraph:
    kind = [EdgeKind.ODOMETRY if odometry else EdgeKind.LOOP_CLOSURE] * 2 + [EdgeKind.LOOP_CLOSURE]
    return ViewGraph.create([0, 1, 0], [1, 2, 2], [[0.0, 0.0, 0.0, 1.0]] * 3, kind=kind)


def _peak_bytes() -> int:
    """Largest resident size of this program. Linux's ru_maxrss would count what the starting process had, too."""
    status = Path("/proc/self/status")
    if status.exists():
        (line,) = (line for line in status.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM:"))
        return 1024 * int(line.split()[1])
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS


def main() -> None:
    """Arguments: the graph's file, the contender, the number of repeats."""
    path, contender, repeats = sys.argv[1:]
    answer = json.dumps(asdict(measure(Path(path), contender, int(repeats))))
    sys.stdout.write(answer + "\n")
    sys.stdout.flush()
    os._exit(0)  # libraries of the peers have been seen to crash while they clean up


if __name__ == "__main__":
    main()
