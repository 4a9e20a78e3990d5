"""What the SLAM suite writes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rotavg_ros.evaluation.common.cases import CaseKey
from rotavg_ros.evaluation.common.contenders import contenders
from rotavg_ros.evaluation.common.scoring import Score, Scores, score_all
from rotavg_ros.evaluation.live import incremental
from rotavg_ros.evaluation.slam import cases, report
from rotavg_ros.evaluation.slam.contenders import ROSTER
from rotavg_ros.evaluation.slam.uncertainty import UncertaintyCheck
from rotavg_ros.metrics import OutlierCounts

from ..laps import spoiled


@pytest.mark.large
def test_report(tmp_path: Path) -> None:
    names = ["neurora", "odometry", "oracle"]
    chosen = contenders(names, ROSTER)
    drawn = [spoiled(), spoiled("0 % random", 0.0), spoiled(cases.GROUPED)]
    scores = score_all(drawn, chosen)
    assert len(scores.rows) == len(drawn) * len(names)
    path = report.report(
        tmp_path,
        scores,
        [incremental.play(drawn[0])],
        [UncertaintyCheck("laps", 0.1, 1.0, 1.1, 0.6, 0.9)],
        "rotavg evaluate slam",
    )
    text = path.read_text(encoding="utf-8")
    assert "error over the oracle's" in text
    written = {path.name for path in tmp_path.iterdir()}
    assert {"slam.md", "slam-cases.csv", "slam-ratios.csv", "slam-ratios.png", "slam-incremental-laps.png"} <= written
    assert len((tmp_path / "slam-cases.csv").read_text().splitlines()) == 1 + len(scores.rows)


def test_recorded_graphs_without_false_closures(tmp_path: Path) -> None:
    """Their flagged closures are no precision of nothing, and their oracle knows less than others."""
    clean = OutlierCounts(0, 4, 0, 112)
    row = Score(CaseKey("B25b_0.500", cases.AS_RECORDED), "neurora", 2.0, 1.0, 2.0, clean, float("nan"), 0, 0.5)
    text = report.report(tmp_path, Scores([row]), [], [], "rotavg evaluate slam").read_text(encoding="utf-8")
    assert "The oracle does without closures whose truth is unknown" in text
    (_, line) = (tmp_path / "slam-recorded.csv").read_text(encoding="utf-8").splitlines()
    assert line.split(",")[3:] == ["2", "", "", "3.4483", "0.5"]
    # The first fifth of some has no closure yet: nothing is flagged of nothing.
    report.report(tmp_path, Scores([replace(row, counts=OutlierCounts(0, 0, 0, 0))]), [], [], "rotavg evaluate slam")
    (_, line) = (tmp_path / "slam-recorded.csv").read_text(encoding="utf-8").splitlines()
    assert line.split(",")[3:] == ["2", "", "", "", "0.5"]
