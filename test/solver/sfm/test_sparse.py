"""Few edges that check each other, between cameras that look every way: CleanNet alone may lead into a wrong valley."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.sfm.solve import _is_sparse, _likelier
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
    chosen = _likelier(both, component, weight, one, other)
    torch.testing.assert_close(chosen, torch.cat((exact, exact)))
    assert _is_sparse(both)
    pairs = torch.combinations(torch.arange(40))
    assert not _is_sparse(ViewGraph.create(pairs[:, 0], pairs[:, 1], exact[:1].repeat(len(pairs), 1)))
