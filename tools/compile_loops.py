"""Has numba compile the solver's loops, by solves that need nearly all: once, not in each process of the tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from rotavg_ros import rotations, solve
from rotavg_ros.evaluation.slam import pose_cases

KIND, SEED, LAST = f"building: {pose_cases.JUMPS}", 5, 4


def main() -> None:
    """Solve a simulated robot's graph with places as it was a few keyframes before its end, and as it is there."""
    (case,) = (kind.draw(SEED) for kind in pose_cases.kinds(Path, [KIND]) if kind.name == KIND)
    assert case is not None
    graph, count = case.graph, case.graph.num_nodes - LAST
    before = replace(graph.select_edges(torch.maximum(graph.source, graph.target) < count), num_nodes=count)
    answer = solve(before)
    start = torch.cat((answer.body_from_world, rotations.identity(LAST)))
    solve(graph, warm_start=start, memory=answer.memory)


if __name__ == "__main__":
    main()
