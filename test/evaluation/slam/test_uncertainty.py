"""Stated uncertainty against errors under known noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from rotavg_ros import Solution, ViewGraph, rotations, solve
from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.evaluation.slam import uncertainty

from ..laps import NUM_NODES, laps


@pytest.mark.parametrize("factor", [pytest.param(1.0, marks=pytest.mark.large), 2.0])
def test_normalized_error_is_error_over_stated(factor: float) -> None:
    graph_file = laps()
    truth = least_squares(graph_file.graph, np.ones(graph_file.graph.num_edges, dtype=bool))
    stated = torch.linspace(0, 0.1, NUM_NODES).double()
    generator = torch.Generator().manual_seed(0)

    def solver(graph: ViewGraph) -> Solution:
        yaw = factor * stated * torch.randn(NUM_NODES, generator=generator).double()
        error = rotations.exp(torch.stack((0 * yaw, 0 * yaw, yaw), dim=1))
        component = torch.zeros(NUM_NODES, dtype=torch.int64)
        estimate = rotations.multiply(truth, error)
        return Solution(estimate, torch.zeros(graph.num_edges), component, stated, {}, "made up", "slam", "cpu")

    checks = list(uncertainty.check("laps", graph_file, 20, seed=0, solver=solver))
    assert [check.step_deg for check in checks] == [step for step, _ in uncertainty.NOISE_DEG]
    for check in checks:
        assert check.normalized_error == pytest.approx(factor, rel=0.06)
        assert check.within_one == pytest.approx(2 * norm.cdf(1 / factor) - 1, abs=0.03)


def test_translations_that_were_measured_with_other_rotations_are_left_out() -> None:
    graph_file = laps()
    graph = graph_file.graph
    translation = torch.ones(graph.num_edges, 3, dtype=torch.float64)
    seen: list[ViewGraph] = []

    def solver(noisy: ViewGraph) -> Solution:
        seen.append(noisy)
        return solve(replace(noisy, translation=None))

    with_translations = replace(graph_file, graph=replace(graph, translation=translation))
    assert list(uncertainty.check("laps", with_translations, 1, seed=0, solver=solver))
    assert all(noisy.translation is None for noisy in seen)
