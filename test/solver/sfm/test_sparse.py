"""Few edges that check each other, between cameras that look every way: CleanNet alone may lead into a wrong valley."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.sfm.solve import _is_sparse, _likelier
from rotavg_ros.solver.sfm.uncertainty import References
from test.solver.graphs import as_quaternions, measured, random_truth


def ring(seed: int, cameras: int, reach: int, false_share: float) -> tuple[ViewGraph, Rotation]:
    """Each camera joined to the next ones around and, now and then, across; noise of 2°."""
    rng = np.random.default_rng(seed)
    near = [(i, (i + k) % cameras) for i in range(cameras) for k in range(1, reach + 1)]
    across = [tuple(rng.choice(cameras, 2, replace=False)) for _ in range(cameras // 4)]
    source, target = np.unique(np.sort(np.array(near + across), axis=1), axis=0).T
    noise = Rotation.from_rotvec(np.radians(2.0) * rng.normal(size=(len(source), 3)))
    is_false = rng.random(len(source)) < false_share
    anyhow = Rotation.random(len(source), rng).as_quat()
    noise = Rotation.from_quat(np.where(is_false[:, None], anyhow, noise.as_quat()))
    truth = random_truth(cameras, seed)
    return measured(truth, source, target, noise), truth


def error_deg(graph: ViewGraph, truth: Rotation, method: str) -> float:
    errors = orientation_errors(solve(graph, method=method).body_from_world, as_quaternions(truth))
    return float(torch.rad2deg(errors).mean())


@pytest.mark.parametrize(("cameras", "reach", "false_share"), [(40, 4, 0.2), (100, 3, 0.05)])
def test_it_is_no_worse_than_without_cleannet(cameras: int, reach: int, false_share: float) -> None:
    graphs = [ring(seed, cameras, reach, false_share) for seed in range(8)]
    ours, without = (
        np.array([error_deg(graph, truth, method) for graph, truth in graphs])
        for method in ("neurora", "neurora-without-cleannet")
    )
    assert ours.mean() < 1.1 * without.mean()
    assert ours.max() < 2 * without.max()


def test_each_component_has_the_better_of_two() -> None:
    graph, truth = ring(0, 20, 3, 0.0)
    both = ViewGraph.create(
        torch.cat((graph.source, graph.source + 20)),
        torch.cat((graph.target, graph.target + 20)),
        graph.target_from_source.repeat(2, 1),
    )
    exact, wrong = as_quaternions(truth), as_quaternions(random_truth(20, 5))
    weight = torch.ones(both.num_edges, dtype=torch.float64)
    component = torch.arange(40) // 20
    one, other = torch.cat((exact, wrong)), torch.cat((wrong, exact))
    chosen = _likelier(both, References(component, torch.tensor([0, 20])), weight, one, other)
    torch.testing.assert_close(chosen, torch.cat((exact, exact)))
    assert _is_sparse(both)
    pairs = torch.combinations(torch.arange(40))
    assert not _is_sparse(ViewGraph.create(pairs[:, 0], pairs[:, 1], exact[:1].repeat(len(pairs), 1)))


def test_a_bridge_is_as_certain_as_the_edges_that_others_check() -> None:
    """It leaves no residual, whatever it states; what is behind it is as uncertain as that may be wrong."""
    scores, is_wrong, deviations = [], [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        ends = np.array([(i, (i + k) % 13) for i in range(13) for k in (1, 2, 3)] + [(0, 13)])
        false = rng.random(len(ends)) < 0.2
        noise = Rotation.from_rotvec(np.radians(1.0) * rng.normal(size=(len(ends), 3))).as_quat()
        noise = Rotation.from_quat(np.where(false[:, None], Rotation.random(len(ends), rng).as_quat(), noise))
        truth = Rotation.from_rotvec(rng.normal(0, 0.4, (14, 3)))
        solution = solve(measured(truth, *np.sort(ends, axis=1).T, noise))
        scores.append(float(solution.outlier_score[-1]))
        deviations.append(float(solution.uncertainty[13]) / float(solution.uncertainty[1:13].max()))
        is_wrong.append(bool(false[-1]))
    assert np.mean(scores) == pytest.approx(np.mean(is_wrong), abs=0.1)
    assert min(scores) > 0.05 and max(scores) < 0.5
    assert min(deviations) > 3


def test_bridges_are_found_and_a_tree_has_nothing_to_tell_by() -> None:
    truth = random_truth(9, 1)
    source, target = np.array([0, 1, 2, 2, 3, 4, 5, 7]), np.array([1, 2, 0, 3, 4, 5, 3, 8])
    solution = solve(measured(truth, source, target))
    assert (solution.outlier_score < 1e-3).all()
    tree = solve(measured(truth, np.arange(8), np.arange(1, 9)))
    assert (tree.outlier_score == 0).all()
