"""Flags between ticks: they do not flicker while data flows, and a cold answer owes nothing to the past."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind, ViewGraph

from ..conftest import TreeSolution, TreeSolver

IDENTITY = (0.0, 0.0, 0.0, 1.0)
CLOSURE = 99


class ScriptedSolver(TreeSolver):
    """Gives every edge the next score of a script."""

    script: list[float]

    def __call__(self, graph: ViewGraph, **options: Any) -> TreeSolution:
        solution = super().__call__(graph, **options)
        return replace(solution, outlier_score=torch.full((graph.num_edges,), self.script.pop(0), dtype=torch.float64))


def odometry(keyframe: int) -> EdgeMeasurement:
    ends = KeyframeReference("r", keyframe), KeyframeReference("r", keyframe + 1)
    return EdgeMeasurement(keyframe, *ends, IDENTITY, EdgeKind.ODOMETRY)


def flags_of(script: list[float], threshold: float = 0.5) -> list[bool]:
    """Flags of a closure whose score changes from tick to tick while the graph grows; the last answer is cold."""
    solver = ScriptedSolver()
    solver.script = list(script)
    options = EstimatorOptions(keyframe_source="edges", gauge="identity", outlier_threshold=threshold)
    estimator = OnlineEstimator(options, solver)
    estimator.add_edge(odometry(0))
    estimator.add_edge(replace(odometry(0), edge_id=CLOSURE, kind=EdgeKind.LOOP_CLOSURE))
    flags = []
    for keyframe in range(1, len(script) + 1):
        answer = estimator.tick()
        assert answer is not None and answer.was_cold == (keyframe in (1, len(script)))
        np.testing.assert_allclose(answer.outlier_score[answer.edge_id == CLOSURE], script[keyframe - 1])
        flags.append(bool(answer.outlier[answer.edge_id == CLOSURE].item()))
        if keyframe < len(script) - 1:
            estimator.add_edge(odometry(keyframe))
    return flags


def test_a_score_about_the_threshold_changes_no_flag() -> None:
    assert flags_of([0.4, 0.6, 0.45, 0.65, 0.45, 0.45]) == [False] * 6
    assert flags_of([0.6, 0.4, 0.55, 0.35, 0.55, 0.55]) == [True] * 6


def test_clear_scores_convict_and_acquit() -> None:
    assert flags_of([0.1, 0.75, 0.4, 0.25, 0.6, 0.1]) == [False, True, True, False, False, False]


def test_a_cold_answer_keeps_nothing() -> None:
    assert flags_of([0.1, 0.8, 0.45, 0.45]) == [False, True, True, False]


@pytest.mark.parametrize("threshold", [0.02, 0.97])
def test_certain_scores_flag_at_any_threshold(threshold: float) -> None:
    assert flags_of([0.0, 1.0, 0.0, 1.0, 0.0], threshold) == [False, True, False, True, False]
