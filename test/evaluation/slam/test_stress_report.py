"""What the stress suite's report counts, on figures that are known."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.scoring import Score, Scores, score_all
from rotavg_ros.evaluation.slam import stress, stress_report
from rotavg_ros.evaluation.slam.stress_calibration import Calibration, statements, table
from rotavg_ros.evaluation.slam.stress_report import Findings
from rotavg_ros.metrics import OutlierCounts

from ..laps import answer_of, spoiled

FIVE_DIGITS = 1e-4  # relative, as CSV files have them


def scored(contender: str, kind: str, errors: list[float]) -> list[Score]:
    counts = OutlierCounts(3, 1, 0, 6)
    return [
        Score(CaseKey("world", kind, seed), contender, error, error, max(error, 0.1), counts, 1.0, 0, 0.5)
        for seed, error in enumerate(errors)
    ]


def made_up() -> Scores:
    """Ours is at the oracle on one kind and ten times off in one of three cases of the other, where GNC is not."""
    scores = Scores()
    for kind, ours, gnc in (("easy", [1.0, 1.0, 1.0], [1.0, 1.1, 0.95]), ("hard", [3.0, 10.0, 4.0], [1.4, 4.0, 2.1])):
        scores.rows += [*scored("neurora", kind, ours), *scored("gnc", kind, gnc), *scored("oracle", kind, [1.0] * 3)]
    return scores


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_report(tmp_path: Path) -> None:
    stress_report.report(tmp_path, made_up(), Findings(Calibration()), "rotavg evaluate slam --suite stress")
    (hard,) = (
        row for row in read(tmp_path / "stress-kinds.csv") if (row["kind"], row["method"]) == ("hard", "neurora")
    )
    assert float(hard["geometric_mean"]) == pytest.approx(120 ** (1 / 3), rel=FIVE_DIGITS)
    assert float(hard["worst"]) == 10
    assert float(hard["p90"]) == pytest.approx(8.8)
    assert (float(hard["share_over_2"]), float(hard["share_over_5"])) == (1, pytest.approx(1 / 3, rel=FIVE_DIGITS))
    ours, gnc, oracle = read(tmp_path / "stress-totals.csv")
    assert float(ours["share over 2×"]) == 0.5
    assert float(ours["kinds where a peer is better"]) == 0.5
    # Of the only peer no other can be told to be better.
    assert gnc["kinds where a peer is better"] == oracle["kinds where a peer is better"] == ""
    (better,) = read(tmp_path / "stress-better.csv")
    assert (better["kind"], better["cases"]) == ("hard", "3")
    assert len(read(tmp_path / "stress-cases.csv")) == 18
    assert read(tmp_path / "stress-worst.csv")[0]["ratio"] == "10"
    # Not those that could have taken part.
    assert "Peers: gnc.\n" in (tmp_path / "stress.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "told", [lambda row: row.contender != "gnc", lambda row: row.case.seed == 0], ids=["no peer", "one case of a kind"]
)
def test_nobody_is_said_to_be_no_better_where_that_cannot_be_told(
    tmp_path: Path, told: Callable[[Score], bool]
) -> None:
    stress_report.report(tmp_path, Scores([*filter(told, made_up().rows)]), Findings(Calibration()), "rotavg")
    assert {row["kinds where a peer is better"] for row in read(tmp_path / "stress-totals.csv")} == {""}


def test_without_false_closures_there_is_no_precision(tmp_path: Path) -> None:
    clean = [replace(row, counts=OutlierCounts(0, 1, 0, 9)) for row in made_up().rows]
    stress_report.report(tmp_path, Scores(clean), Findings(Calibration()), "rotavg")
    assert {(row["precision"], row["recall"]) for row in read(tmp_path / "stress-totals.csv")} == {("", "")}


def test_a_report_of_nothing(tmp_path: Path) -> None:
    """Interrupted before the first case was done."""
    assert stress_report.report(tmp_path, Scores(), Findings(Calibration()), "rotavg").exists()


def test_an_interruption_keeps_what_is_done(tmp_path: Path) -> None:
    calibration = Calibration()
    solved = []

    def contender(case: Case) -> Answer:
        if len(solved) == 2:
            raise KeyboardInterrupt
        solved.append(case)
        return answer_of("oracle", case)

    scores = score_all([spoiled(seed=seed) for seed in range(3)], {"neurora": calibration.watching(contender)})
    assert scores.interrupted
    stress_report.report(tmp_path, scores, Findings(calibration), "rotavg")
    assert len(read(tmp_path / "stress-cases.csv")) == 2
    assert int(read(tmp_path / "stress-calibration.csv")[0]["edges judged"]) > 0


def test_statements() -> None:
    """Unsure scores, and errors of known size against what is stated of them."""
    case = next(iter(stress.kinds(["hills: 30 % random"]))).draw(0)
    assert case is not None
    number = case.graph.num_nodes
    error = torch.zeros(number, 3, dtype=torch.float64)
    error[1:, 0] = 0.1
    # One component of three is 0.1 off, which is 1.5 standard deviations.
    answer = Answer(
        rotations.multiply(case.truth, rotations.exp(error)),
        1.0,
        1.0,
        torch.where(case.is_false, 0.75, 0.01).double(),
        torch.full((number,), 0.1 / 1.5, dtype=torch.float64),
    )
    found = statements(case, answer)
    assert found.num_unsure == int(case.is_false.sum())
    assert found.unsure.error == pytest.approx(0.25)
    assert found.num_errors == 3 * (number - 1)
    assert (found.within_one, found.within_two) == (2 * (number - 1), 3 * (number - 1))
    (row,) = table("Calibration", {"hills": found}, every_kind=False).rows
    assert row[3:] == pytest.approx((0.25, 2 / 3, 1))
    # Slips that may as well be false closures count by themselves, too.
    either = statements(case, replace(answer, outlier_score=torch.full_like(case.noise, 0.5)))
    of_kinds = {"hills": found, "lone slip: 3 witnesses, one pair of places": either}
    everything, known, *kinds = table("Calibration", of_kinds, every_kind=True).rows
    assert everything[1] == 2 * found.num_judged
    assert (known[0], known[1:]) == ("all but those of one pair of places", row[1:])
    assert [kind[0] for kind in kinds] == [*of_kinds]


def test_planar_errors_are_those_of_the_yaw() -> None:
    case = next(iter(stress.kinds(["building: 30 % random"]))).draw(0)
    assert case is not None
    number = case.graph.num_nodes
    stated = torch.full((number,), 0.1, dtype=torch.float64)
    stated[-1] = torch.nan  # nothing is stated of the last one
    found = statements(case, Answer(case.truth, 1.0, 1.0, None, stated))
    assert (found.num_judged, found.num_errors, found.within_two) == (0, number - 2, number - 2)
