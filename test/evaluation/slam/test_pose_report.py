"""What the report of the suite of poses counts, on figures that are known."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from rotavg_ros.evaluation.common.cases import CaseKey
from rotavg_ros.evaluation.common.scoring import Score, Scores
from rotavg_ros.evaluation.slam import pose_cases, pose_report
from rotavg_ros.evaluation.slam.pose_contenders import ROWS
from rotavg_ros.metrics import OutlierCounts

FIVE_DIGITS = 1e-4  # relative, as CSV files have them


def scored(contender: str, kind: str, metres: list[float], counts: OutlierCounts) -> list[Score]:
    return [
        Score(CaseKey("hall", kind, seed), contender, 1.0, 1.0, 1.0, counts, 1.0, 0, 0.5, each, max(each, 0.05))
        for seed, each in enumerate(metres)
    ]


def made_up() -> Scores:
    scores, right, clean = Scores(), OutlierCounts(9, 1, 0, 20), OutlierCounts(0, 2, 0, 8)
    for kind, ours, gnc, counts in (
        ("30 % random", [0.1, 0.4], [0.2, 0.2], right),
        ("no false closures", [0.3, 0.3], [0.1, 0.1], clean),
        ("as recorded", [1.2], [1.0], right),
    ):
        number = len(ours)
        scores.rows += scored("neurora", kind, ours, counts)
        scores.rows += scored("gnc-true", kind, gnc, counts)
        scores.rows += scored("oracle", kind, [0.1] * number, counts)
    return scores


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_report(tmp_path: Path) -> None:
    path = pose_report.report(tmp_path, made_up(), "rotavg evaluate slam --suite poses")
    text = path.read_text(encoding="utf-8")
    assert "Peers: gnc-true.\n" in text
    assert not (tmp_path / "poses-sound.csv").exists()
    assert "4 drawings (seeds 0, 1)" in text and "1 recorded graphs" in text
    totals = text.partition("## Positions")[0]
    assert "share of good closures that are not flagged stands in place" in totals
    ours, gnc, oracle = read(tmp_path / "poses-totals.csv")
    assert float(ours["ATE ratio"]) == pytest.approx((1 * 4 * 3 * 3) ** (1 / 4), rel=FIVE_DIGITS)
    assert float(ours["share over 2×"]) == 0.75
    assert float(gnc["ATE ratio"]) == pytest.approx((2 * 2 * 1 * 1) ** (1 / 4), rel=FIVE_DIGITS)
    assert float(oracle["ATE ratio"]) == 1.0
    assert float(ours["precision"]) == pytest.approx(18 / 24)
    first = read(tmp_path / "poses-positions.csv")[0]
    assert float(first["30 % random"]) == pytest.approx(2.0)
    verdicts = read(tmp_path / "poses-verdicts.csv")[0]
    assert (float(verdicts["30 % random: P"]), float(verdicts["no false closures: P"])) == (0.9, 0.8)
    better = read(tmp_path / "poses-better.csv")
    assert [(row["condition"], row["drawings"]) for row in better] == [("no false closures", "2"), ("as recorded", "1")]
    assert float(better[0]["its ATE over ours"]) == pytest.approx(1 / 3, rel=FIVE_DIGITS)
    assert [row["method"] for row in read(tmp_path / "poses-recorded.csv")][1].startswith("GNC")
    assert len(read(tmp_path / "poses-cases.csv")) == 15
    assert read(tmp_path / "poses-worst.csv")[0]["condition"] == "as recorded"


def test_peers_that_are_told_that_odometry_is_right_are_compared_also_where_it_is(tmp_path: Path) -> None:
    counts = OutlierCounts(9, 1, 0, 20)
    scores = made_up()
    for name, metres in (("neurora", 0.1), ("gnc-true", 8.0), ("oracle", 0.1)):
        scores.rows += scored(name, pose_cases.JUMPS, [metres], counts)
    text = pose_report.report(tmp_path, scores, "rotavg").read_text(encoding="utf-8")
    assert f"Under '{pose_cases.JUMPS}' odometry is not right" in text
    everything, sound = (
        {row["method"]: float(row["ATE ratio"]) for row in read(tmp_path / f"poses-{table}.csv")}
        for table in ("totals", "sound")
    )
    gnc = ROWS["gnc-true"]
    assert (everything[gnc], sound[gnc]) == pytest.approx(((4 * 80) ** (1 / 5), 4 ** (1 / 4)), rel=FIVE_DIGITS)


def test_a_report_of_nothing(tmp_path: Path) -> None:
    """Interrupted before the first case was done."""
    assert pose_report.report(tmp_path, Scores(), "rotavg").exists()


def test_good_closures_that_a_recorded_graph_alone_has_are_no_precision_of_nothing(tmp_path: Path) -> None:
    clean = OutlierCounts(0, 4, 0, 112)
    row = Score(CaseKey("B25b_0.500", "as recorded"), "gnc-true", 1.0, 1.0, 1.0, clean, 1.0, 0, 0.5, 1.0, 1.0)
    pose_report.report(tmp_path, Scores([row]), "rotavg")
    (recorded,) = read(tmp_path / "poses-recorded.csv")
    assert (float(recorded["precision"]), recorded["recall"]) == (pytest.approx(112 / 116, rel=FIVE_DIGITS), "")


def test_the_note_on_recorded_graphs_tells_what_each_was_told(tmp_path: Path) -> None:
    row = Score(
        CaseKey("B25b_0.250", "as recorded"), "neurora", 1.0, 1.0, 1.0, OutlierCounts(1, 0, 0, 1), 1.0, 0, 0.5, 1.0, 1.0
    )
    text = pose_report.report(tmp_path, Scores([row]), "rotavg").read_text(encoding="utf-8")
    assert "leave against it: B25b_0.250 0.18° and 0.015 m a step, 2.3° and 0.29 m a good closure. The oracle" in text
