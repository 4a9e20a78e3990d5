"""A pose graph that is played edge by edge."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.evaluation.common.scoring import score
from rotavg_ros.evaluation.live import incremental, tables
from rotavg_ros.evaluation.slam import pose_cases

from ..laps import NUM_NODES, answer_of, spoiled


@pytest.mark.large
def test_incremental_run_ends_like_the_batch_solve() -> None:
    case = spoiled()
    run = incremental.play(case)
    assert run.keyframes.tolist() == list(range(10, NUM_NODES + 1, 10))
    assert run.false_seen[-1] == case.is_false.sum()
    assert run.good_seen[-1] == case.is_good.sum()
    batch = score(case, "neurora", answer_of("neurora", case))
    assert run.error_deg[-1] == pytest.approx(batch.mean_deg, abs=0.1)
    assert np.isnan(run.worst_excess_deg)  # a short run settles nothing
    assert (run.after_seconds > 0).all()


@pytest.mark.large
def test_a_right_rotation_is_not_flagged_for_the_wrong_place_that_it_joins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a case whose rotations alone are judged."""
    monkeypatch.setattr(incremental, "KEYFRAMES_PER_TICK", 250)
    kind, *_ = pose_cases.kinds(Path, ["sparse building: 30 % parallel corridors"])
    case = kind.draw(0)
    assert case is not None and case.poses is not None
    by_places, by_rotations = incremental.play(case), incremental.play(replace(case, poses=None))
    assert by_places.false_flagged[-1] > 0.8 * by_places.false_seen[-1] > 8
    assert by_rotations.good_flagged[-1] < 0.3 * by_places.false_flagged[-1]


def test_work_after_an_answer_is_told_beside_it() -> None:
    """It takes several times as long: of both together, or of one of them, "a tick" says nothing."""
    zeros = np.zeros(2)
    run = incremental.IncrementalRun(
        spoiled(), np.array([10.0, 20.0]), *[zeros] * 8, seconds=np.array([0.01, 0.03]), after_seconds=zeros + 0.1
    )
    table = tables.incremental("Incremental", [run])
    (row,) = table.rows
    told = dict(zip((column.heading for column in table.columns), row, strict=True))
    assert [told[f"answer {quantile} ms"] for quantile in ("p50", "p95")] == pytest.approx([20, 29])
    assert [told[f"after it {quantile} ms"] for quantile in ("p50", "p95")] == pytest.approx([100, 100])
