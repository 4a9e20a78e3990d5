"""Parts of a real robot's graph in which most closures join wrong places, some of them seen from behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rotavg_ros import solve
from rotavg_ros.evaluation.common.scoring import orientation_errors
from rotavg_ros.evaluation.slam import cases


# The longest is right by rotations alone.
@pytest.mark.parametrize(
    "beginning",
    [
        pytest.param(name, marks=() if name == "first 20 %" else pytest.mark.large)
        for name in list(cases.BEGINNINGS)[:-1]
    ],
)
def test_no_slip_is_invented_for_corridors_seen_from_behind(shared_data: Path, beginning: str) -> None:
    """By rotations alone a slip of half a turn is as likely; none of its witnesses joins the right places."""
    kind = next(kind for kind in cases.kinds(shared_data, ["B25b_0.000"], []) if kind.name == beginning)
    case = kind.draw(0)
    assert case is not None
    solution = solve(case.graph)
    assert solution.rotation_score is not None
    assert not (solution.rotation_score[case.graph.is_odometry] > 0.5).any()
    errors = orientation_errors(solution.body_from_world, case.truth, case.graph.components())
    # Such a slip turns all beyond it by 80 degrees. After 40 % eight closures of 111 are right: 3.5 degrees.
    assert errors[errors.isfinite()].rad2deg().mean() < (4.0 if beginning == "first 40 %" else 2.5)


@pytest.mark.parametrize(
    ("first", "last", "most_deg"),
    [
        # Of 61 closures none joins the right places, and 30 say one and the same wrong thing: odometry has 3.0°.
        pytest.param(0.45, 0.9, 3.5, marks=pytest.mark.large),
        # Odometry has 2.8°; a slip of half a turn with none of its witnesses in place had been likelier.
        pytest.param(0.3, 1.0, 3.3, marks=pytest.mark.large),
        pytest.param(0.3, 0.7, 2.0, marks=pytest.mark.large),
    ],
)
def test_a_stretch_of_a_real_run_by_itself_is_no_worse_than_its_odometry(
    shared_data: Path, first: float, last: float, most_deg: float
) -> None:
    run = cases.b25b("0.000", shared_data / "slam")
    assert run.body_from_world_gt is not None
    begin, end = (int(share * run.graph.num_nodes) for share in (first, last))
    inside = (torch.minimum(run.graph.source, run.graph.target) >= begin) & (
        torch.maximum(run.graph.source, run.graph.target) < end
    )
    stretch = run.graph.select_edges(inside)
    graph = replace(stretch, source=stretch.source - begin, target=stretch.target - begin, num_nodes=end - begin)
    truth = torch.from_numpy(run.body_from_world_gt[begin:end])
    errors = orientation_errors(solve(graph).body_from_world, truth, graph.components())
    assert errors[errors.isfinite()].rad2deg().mean() < most_deg
