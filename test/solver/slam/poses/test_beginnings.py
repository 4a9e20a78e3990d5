"""The beginnings of a real robot's graph, where most closures join wrong places, some of them seen from behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from rotavg_ros import solve
from rotavg_ros.evaluation.common.cases import Case
from rotavg_ros.evaluation.common.scoring import orientation_errors
from rotavg_ros.evaluation.slam import cases


def mean_deg(case: Case) -> float:
    solution = solve(case.graph)
    errors = orientation_errors(solution.body_from_world, case.truth, case.graph.components())
    return float(errors[errors.isfinite()].rad2deg().mean())


# The longest is right by rotations alone.
@pytest.mark.parametrize("beginning", list(cases.BEGINNINGS)[:-1])
def test_no_slip_is_invented_for_corridors_seen_from_behind(shared_data: Path, beginning: str) -> None:
    """By rotations alone a slip of half a turn is as likely; none of its witnesses joins the right places."""
    kind = next(kind for kind in cases.kinds(shared_data, ["B25b_0.000"], []) if kind.name == beginning)
    case = kind.draw(0)
    assert case is not None
    assert mean_deg(case) < 2.5
