"""What the SLAM suite writes."""

from __future__ import annotations

from pathlib import Path

import pytest

from rotavg_ros.evaluation.common.contenders import contenders
from rotavg_ros.evaluation.common.scoring import score_all
from rotavg_ros.evaluation.live import incremental
from rotavg_ros.evaluation.slam import cases, report
from rotavg_ros.evaluation.slam.contenders import ROSTER
from rotavg_ros.evaluation.slam.uncertainty import UncertaintyCheck

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
