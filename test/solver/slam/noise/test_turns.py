"""How far steps turn is not told by their own noise, or the steps that err by most would seem to turn by most."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import rotations, solve
from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest
from rotavg_ros.solver.slam.noise.turns import squared_turns
from rotavg_ros.solver.slam.preparation import prepare_as_it_is
from rotavg_ros.view_graph import EdgeKind, ViewGraph


def drive(turns_deg: np.ndarray) -> ViewGraph:
    """Odometry along a chain that turns so far about the vertical at each step, and a closure over all of it."""
    count = len(turns_deg)
    vector = np.zeros((count + 1, 3))
    vector[:count, 2] = np.radians(turns_deg)
    vector[count, 2] = np.radians(turns_deg.sum())
    kind = [EdgeKind.ODOMETRY] * count + [EdgeKind.LOOP_CLOSURE]
    measured = rotations.exp(torch.from_numpy(vector))
    return ViewGraph.create([*range(count), 0], [*range(1, count + 1), count], measured, kind=kind)


def counted_deg(turns_deg: np.ndarray, noise_deg: float) -> np.ndarray:
    """By how much each step counts as turning."""
    graph = drive(turns_deg)
    passed = squared_turns(graph, prepare_as_it_is(graph).forest, float(np.radians(noise_deg) ** 2))
    return np.degrees(np.sqrt(np.abs(np.diff(passed))))


def test_a_step_that_errs_by_more_does_not_seem_to_turn_by_more() -> None:
    turns = np.full(20, 5.0)
    turns[10] += 2.0  # twice its noise
    counted = counted_deg(turns, 1.0)
    assert counted[10] < 5.5
    np.testing.assert_allclose(counted[:9], 5.0, atol=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_turn_of_one_step_is_its_own(sign: float) -> None:
    turns = np.zeros(20)
    turns[10] = sign * 90.0
    counted = counted_deg(turns, 0.3)
    assert counted[10] == pytest.approx(90.0, rel=1e-3)
    assert counted[[9, 11]].max() < 1.0


@pytest.mark.parametrize("root", [7, 19])
def test_it_does_not_depend_on_the_root(root: int) -> None:
    turns = np.random.default_rng(0).normal(0.0, 5.0, 20)
    node = np.arange(21)
    parent = np.where(node < root, node + 1, np.where(node > root, node - 1, root))
    parent_edge = np.where(node < root, node, np.where(node > root, node - 1, -1))
    forest = SpanningForest(parent, parent_edge, np.zeros(21, dtype=np.int64))
    passed = squared_turns(drive(turns), forest, float(np.radians(1.0) ** 2))
    counted = np.degrees(np.sqrt(np.abs(np.diff(passed))))
    np.testing.assert_allclose(counted, counted_deg(turns, 1.0), rtol=1e-9)


@pytest.mark.parametrize("seed", [0, pytest.param(5, marks=pytest.mark.large)])
def test_no_gyroscope_is_biased_where_noise_is_as_large_as_turns_differ(seed: int, shared_data: Path) -> None:
    """On a sphere that is driven around in circles a bias turns each circle by a little, which closures hardly tell."""
    graph = read_graph(shared_data / "slam" / "sphere2500.g2o").graph
    truth = least_squares(graph, np.ones(graph.num_edges, dtype=bool))
    sigma = np.radians(np.where(graph.is_odometry.numpy(), 1.5, 0.5))
    noise = sigma[:, None] * np.random.default_rng(seed).normal(size=(graph.num_edges, 3))
    exact = rotations.multiply(truth[graph.target], rotations.inverse(truth[graph.source]))
    measured = rotations.multiply(rotations.exp(torch.from_numpy(noise)), exact)
    precision = torch.full_like(graph.precision, torch.nan)
    solution = solve(replace(graph, target_from_source=measured, precision=precision, translation=None))
    errors = orientation_errors(solution.body_from_world, truth, solution.component)
    assert np.degrees(float(errors.mean())) < 1.6  # 2.1 and 12.1° with each step's own turn
