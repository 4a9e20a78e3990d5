"""Scores of closures whose rotation is slightly wrong, where translations are known."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros import solve
from rotavg_ros.evaluation.slam import stress

UNSURE = 0.95


@pytest.mark.parametrize(("world", "seed"), [("grid", 7), ("building", 8)])
def test_a_place_seen_turned_by_more_than_ten_degrees_is_false(world: str, seed: int) -> None:
    """False closures that err by 12 to 20° and a metre or two: a place that looks alike, seen nearly alike."""
    (kind,) = (kind for kind in stress.kinds(translations=True) if kind.name == f"{world}: 30 % near misses")
    case = kind.draw(seed)
    assert case is not None
    solution = solve(case.graph)
    assert solution.rotation_score is not None
    closure = ~case.graph.is_odometry
    false, good = closure & case.is_false, closure & case.is_good
    assert int(false.sum()) > 50
    for score in (solution.rotation_score, solution.outlier_score):
        np.testing.assert_array_less(UNSURE, score[false].numpy())
        np.testing.assert_array_less(score[good].numpy(), 1 - UNSURE)
