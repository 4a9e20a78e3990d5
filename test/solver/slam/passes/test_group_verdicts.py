"""Groups of false closures that agree with each other."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph, rotations, solve
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver.slam import preparation as slam_preparation
from rotavg_ros.solver.slam import stages as slam_stages
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.passes.alternation import Passes, Start
from rotavg_ros.solver.slam.passes.group_verdicts import if_turned
from rotavg_ros.solver.slam.passes.system import WholeSystem
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

    graph, _, is_false = there_and_back(0 if not planar else 5, 20.0 if planar else 30.0, planar)
    prepared = slam_preparation.prepare(graph)
    cleaned = slam_stages.clean(None, prepared, graph.label)
    start = slam_stages.bootstrap(prepared, cleaned)
    one_by_one = slam_stages.refine_and_search(prepared, cleaned, start, stages=SlamStages(group_search=False))
    assert (prepared.closure_graph.edge_values(one_by_one.outlier_probability)[is_false] < 0.5).all()


def test_information_on_a_groups_turn_is_what_least_squares_with_it_has() -> None:
    graph = there_and_back(0, 0.0, planar=False)[0]
    closure_graph, _ = slam_preparation.draw_together(graph)
    state, system, num_edges = settled(closure_graph)
    member = np.zeros((num_edges, 2))
    member[-12:-6, 0] = member[-3:, 1] = 1.0
    gives_way, information = if_turned(state, system, member)

    nodes = np.delete(np.eye(closure_graph.num_nodes), closure_graph.roots, axis=1)
    design = np.hstack((nodes[closure_graph.target] - nodes[closure_graph.source], member))
    root = np.sqrt(system.factorised.weight)[:, None]
    covariance = np.linalg.inv((root * design).T @ (root * design))
    assert_allclose(information, np.linalg.inv(covariance[-2:, -2:]), rtol=1e-6)
    fit = np.linalg.lstsq(root * design[:, :-2], root * member, rcond=None)[0]
    assert_allclose(gives_way, design[:, :-2] @ fit, atol=1e-6)


def settled(graph: ClosureGraph) -> tuple[Passes, WholeSystem, int]:
    """Passes over a closure graph that believe everything, its system, and the number of its edges."""
    noise = NoiseModel(3, np.radians(0.3) ** 2, np.radians(0.4) ** 2, 0.1)
    system, num_edges = WholeSystem(graph), len(graph.source)
    start = rotations.identity(graph.num_nodes)
    state = Passes(Start(graph, start, np.ones(num_edges), noise, np.zeros(num_edges)), system, hold_noise=True)
    state.alternate(noise.step_variance, 5)
    return state, system, num_edges
