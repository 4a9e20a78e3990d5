"""Scores as tables."""

from __future__ import annotations

import numpy as np

from rotavg_ros.evaluation.common.cases import CaseKey
from rotavg_ros.evaluation.common.score_tables import Figure, averages, good_flagged, per_case, precision_and_recall
from rotavg_ros.evaluation.common.scoring import Score, Scores
from rotavg_ros.metrics import OutlierCounts

FIGURES = (Figure("mean_deg", "mean °", ".2f"), Figure("counts.recall", "recall"))


def row(seed: int, contender: str, mean_deg: float) -> Score:
    counts = OutlierCounts(1, 0, seed, 1)
    return Score(CaseKey("graph", "kind", seed), contender, mean_deg, mean_deg, mean_deg, counts, 1.0, 0, 0.1)


SCORES = Scores([row(0, "a", 1.0), row(0, "b", 5.0), row(1, "a", 3.0)])


def test_averages() -> None:
    table = averages("Title", SCORES, ["a", "b"], FIGURES, "A note.")
    assert table.rows == (("a", 2.0, 0.75), ("b", 5.0, 1.0))
    assert table.to_markdown().splitlines()[4:] == ["| a | 2.00 | 0.75 |", "| b | 5.00 | 1.0 |", "", "A note."]
    (nobody,) = averages("Title", SCORES, ["nobody"], FIGURES).rows
    assert np.isnan(nobody[1])


def test_a_row_for_every_case() -> None:
    key = {"graph": "name", "condition": "kind", "seed": "seed"}
    lines = per_case("Title", SCORES, FIGURES, key).to_csv().splitlines()
    assert lines[0] == "graph,condition,seed,method,mean °,recall"
    assert lines[1:] == ["graph,kind,0,a,1,1", "graph,kind,0,b,5,1", "graph,kind,1,a,3,0.5"]
    assert per_case("Title", SCORES, FIGURES).to_csv().startswith("graph,method,mean °,recall\ngraph,a,1,1\n")


def test_precision_and_recall_of_nothing_are_empty() -> None:
    assert precision_and_recall(OutlierCounts(3, 1, 2, 5)) == (0.75, 0.6)
    # Of good closures alone, 0 and 1 would look like a verdict on false ones.
    assert precision_and_recall(OutlierCounts(0, 4, 0, 112)) == (None, None)
    assert (good_flagged(OutlierCounts(0, 1, 0, 3)), good_flagged(OutlierCounts(5, 0, 1, 0))) == (0.25, None)
