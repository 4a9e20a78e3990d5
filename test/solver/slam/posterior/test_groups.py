"""Groups of false closures that agree with each other."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph, solve
from rotavg_ros.metrics.orientations import orientation_errors
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise

NUM_NODES, STRETCHES = 400, (10, 40, 70, 100, 130, 160)


def there_and_back(seed: int, turn_deg: float, planar: bool = True) -> tuple[ViewGraph, Rotation, np.ndarray]:
    """A path that is met again on the way back, in six stretches, one of which is off by a turn of the world."""
    truth = random_truth(NUM_NODES, seed, planar)
    first = np.concatenate([np.arange(start, start + 16, 2) for start in STRETCHES])
    source = np.concatenate((np.arange(NUM_NODES - 1), first))
    target = np.concatenate((np.arange(1, NUM_NODES), NUM_NODES - 1 - first))
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [NUM_NODES - 1, len(first)])
    noise = small_noise(len(source), np.repeat([0.3, 0.4], [NUM_NODES - 1, len(first)]), seed, planar)
    is_false = np.isin(np.arange(len(source)) - (NUM_NODES - 1), np.arange(16, 24))
    # Of the world, as every member sees it from where it starts.
    turn = Rotation.from_rotvec(np.outer(is_false, [0, 0, np.radians(turn_deg)]))
    graph = measured(truth, source, target, truth[source] * turn * truth[source].inv() * noise, kind=kind)
    return graph, truth, is_false


@pytest.mark.large
@pytest.mark.parametrize("planar", [True, False])
def test_a_group_that_agrees_counts_as_one(planar: bool) -> None:
    believed = []
    for seed in range(6):
        graph, truth, is_false = there_and_back(seed, 20.0 if planar else 30.0, planar)
        solution = solve(graph, profile="slam")
        rejected = solution.outlier_score.numpy() > 0.5
        assert not (rejected & ~is_false).any()
        believed.append((is_false & ~rejected).any())
        if not believed[-1]:
            error = orientation_errors(solution.body_from_world, as_quaternions(truth), solution.component)
            assert float(error.mean()) < np.radians(3)
    assert sum(believed) <= (3 if planar else 0)
