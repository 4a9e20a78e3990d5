"""Positions and residuals of an answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import EdgeKind, ViewGraph


def answered(scale: str = "metric") -> tuple[Answer, ViewGraph]:
    """A simulated run's edges through the estimator, and the same graph."""
    config = SlamSimulationConfig(num_keyframes=200, laps=3.0, closures_per_keyframe=0.2, false_share=0.2)
    run = simulate_slam_graph(config, np.random.default_rng(0))
    graph = replace(run.graph, translation=torch.from_numpy(run.edge_translation))
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges", translation_scale=scale))
    for edge in range(graph.num_edges):
        ends = (KeyframeReference("r", keyframe_id=int(end[edge])) for end in (graph.source, graph.target))
        measured = EdgeMeasurement(
            edge,
            *ends,
            graph.target_from_source[edge].tolist(),
            EdgeKind.ODOMETRY if graph.is_odometry[edge] else EdgeKind.LOOP_CLOSURE,
            translation=run.edge_translation[edge].tolist(),
        )
        assert estimator.add_edge(measured) is None
    answer = estimator.tick(force_cold=True)
    assert answer is not None
    return answer, replace(graph, precision=torch.full_like(graph.precision, torch.nan))


def test_the_estimator_says_what_the_solver_says() -> None:
    answer, graph = answered()
    position = solve(graph).position
    assert position is not None
    assert answer.position is not None and answer.residual_m is not None and answer.rotation_score is not None
    order = np.argsort(answer.keyframe_id)
    np.testing.assert_allclose(answer.position[order], position.numpy(), atol=1e-6)
    good = ~answer.outlier
    assert np.median(answer.residual_m[good]) < 0.1 < 2.0 < answer.residual_deg[answer.outlier].max()


def test_an_answer_whose_residuals_were_asked_for_can_be_emptied() -> None:
    answer, _ = answered()
    assert len(answer.residual_deg) == len(answer.source) and answer.residual_m is not None
    nothing = answer.without_content()
    assert nothing.position is not None and len(nothing.position) == len(nothing.residual_deg) == 0


def test_translations_that_are_no_metres_tell_positions_alone() -> None:
    answer, graph = answered("none")
    assert answer.position is None and answer.rotation_score is None
    alone = solve(replace(graph, translation=None))
    order = np.argsort(answer.edge_id)
    np.testing.assert_allclose(answer.outlier_score[order], alone.outlier_score.numpy(), atol=1e-6)
    assert np.isfinite(answer.translation).all()  # along which the path is laid
