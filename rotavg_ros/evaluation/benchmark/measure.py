"""Measure one contender on one graph in this process: ``python -m rotavg_ros.evaluation.benchmark.measure``.

Prints one line of JSON. A process of its own gives every contender the same memory and threads to start from, its own
peak memory, and nothing of what another left behind.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch

from rotavg_ros.evaluation.benchmark.plans import load
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.cases import warm_up_case
from rotavg_ros.evaluation.common.named_peers import PEERS
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import ViewGraph

# Contenders by name, and their names in reports.
LABELS = {
    "neurora": "rotavg",
    "neurora-v1": "rotavg without refinement",
    "neurora-cuda": "rotavg on a GPU",
    "colmap": "COLMAP",
    "shonan": "GTSAM Shonan",
    "gnc": "GTSAM GNC",
}
# Solves are repeated until they have taken this long.
ENOUGH_S = 15.0
OURS = frozenset({"neurora", "neurora-v1", "neurora-cuda"})


@dataclass(frozen=True)
class Measurement:
    """The result of one process.

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


class _Run(NamedTuple):
    """One solve, and the wall-clock seconds of its stages if it reports them."""

    answer: Answer
    stages: dict[str, float]


def measure(path: Path, contender: str, repeats: int) -> Measurement:
    """Solve the graph in a file, after a tiny one that pays the one-time costs of a process.

    Args:
        repeats: largest number of solves; fewer if they take more than :data:`ENOUGH_S`.
    """
    case = load(path)
    run = _ours(contender) if contender in OURS else _peer(contender)
    run(warm_up_case(case.family).graph)
    before = _peak_bytes()
    runs = [run(case.graph)]
    while len(runs) < repeats and sum(one.answer.seconds for one in runs) < ENOUGH_S:
        runs.append(run(case.graph))
    typical = sorted(runs, key=lambda one: one.answer.seconds)[len(runs) // 2]
    peak = _peak_bytes()
    error = torch.rad2deg(orientation_errors(typical.answer.body_from_world, case.truth))
    return Measurement(
        contender,
        case.graph.num_nodes,
        case.graph.num_edges,
        [one.answer.seconds for one in runs],
        [one.answer.cpu_seconds for one in runs],
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
        graph = replace(graph)  # a graph caches its components; every repeat has to find them anew
        clock = Clock()
        with clock.running():
            solution = solve(graph, method=method, device=device)
        answer = Answer(solution.body_from_world, clock.seconds, clock.cpu_seconds, solution.outlier_score)
        return _Run(answer, solution.stage_seconds)

    return run


def _peer(contender: str) -> Callable[[ViewGraph], _Run]:
    def run(graph: ViewGraph) -> _Run:
        return _Run(PEERS[contender].solve(graph), {})

    return run


def _peak_bytes() -> int:
    """Largest resident size of this program. Linux's ru_maxrss would also count that of the starting process."""
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
    os._exit(0)  # some of the peers' libraries crash during cleanup


if __name__ == "__main__":
    main()
