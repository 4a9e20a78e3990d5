"""What is said of an answer in sentences."""

from __future__ import annotations

import torch

from rotavg_ros import rotations
from rotavg_ros.solver.pipeline import solve
from rotavg_ros.view_graph import EdgeKind, ViewGraph


def test_a_slip_that_other_odometry_tells_of_is_not_laid_to_closures() -> None:
    """Wheels and a camera between the same keyframes, of which one is off by 57° once."""
    generator = torch.Generator().manual_seed(0)

    def turns(spread: float) -> torch.Tensor:
        return rotations.exp(spread * torch.randn(39, 3, generator=generator, dtype=torch.float64))

    true = turns(0.3)
    wheels, camera = (rotations.multiply(true, turns(0.01)) for _ in range(2))
    slip = rotations.exp(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    camera[20] = rotations.multiply(slip, camera[20])
    first = torch.arange(39).repeat(2)
    odometry = torch.full((78,), int(EdgeKind.ODOMETRY), dtype=torch.int8)
    graph = ViewGraph.create(first, first + 1, torch.cat([wheels, camera]), num_nodes=40, kind=odometry)
    (warning,) = solve(graph, profile="slam").warnings
    assert "(between nodes 20 and 21): other odometry between the same nodes disagrees with it" in warning
