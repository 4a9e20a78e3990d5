from __future__ import annotations

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import ReleasedRecipe
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import SLAM, Case, CaseKey
from rotavg_ros.evaluation.common.contenders import contenders, warm_up
from rotavg_ros.evaluation.common.scoring import Score, Scores, geometric_mean, score, score_all
from rotavg_ros.evaluation.sfm.contenders import ROSTER
from rotavg_ros.metrics import OutlierCounts
from rotavg_ros.view_graph import ViewGraph


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    rng = np.random.default_rng(0)
    samples = [ReleasedRecipe(cameras=(40, 60)).sample(rng) for _ in range(2)]
    return [Case(CaseKey(str(number)), sample.graph, sample.body_from_world) for number, sample in enumerate(samples)]


def answer(case: Case, orientations: torch.Tensor, score: torch.Tensor | None = None, seconds: float = 0.0) -> Answer:
    return Answer(orientations, seconds, seconds, torch.zeros(case.graph.num_edges) if score is None else score)


def test_truth_in_another_gauge_scores_zero_degrees(cases: list[Case]) -> None:
    case = cases[0]
    turned = rotations.multiply(case.truth, rotations.random(1, generator=torch.Generator().manual_seed(1)))
    known = score(case, "truth", answer(case, turned, score=(case.noise > np.radians(20)).double(), seconds=0.5))
    assert known.mean_deg == pytest.approx(0, abs=1e-4)
    counts = known.counts
    assert (counts.accuracy, counts.precision, counts.recall, known.roc_area, known.cpu_seconds) == (1, 1, 1, 1, 0.5)


def test_error_of_one_orientation_is_its_angle(cases: list[Case]) -> None:
    case = cases[0]
    wrong = case.truth.clone()
    wrong[3] = rotations.multiply(wrong[3], rotations.exp(torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)))
    errors = score(case, "wrong", answer(case, wrong))
    assert errors.mean_deg == pytest.approx(np.degrees(0.5) / len(wrong), rel=1e-3)
    assert errors.median_deg == pytest.approx(0, abs=1e-3)
    assert errors.counts.recall == 0


def test_every_contender_runs_and_the_oracle_leads(cases: list[Case]) -> None:
    pytest.importorskip("pycolmap")
    pytest.importorskip("gtsam")
    names = ("neurora", "neurora-unweighted", "neurora-without-finenet", "spt+chatterjee", "colmap", "shonan", "oracle")
    chosen = contenders(names, ROSTER)
    warm_up(chosen.values(), ROSTER)
    scores = score_all(cases, chosen)
    assert [(row.case, row.contender) for row in scores.rows] == [(case.key, name) for case in cases for name in names]
    for name in set(names) - {"oracle"}:
        assert scores.mean("oracle", "mean_deg") <= 1.1 * scores.mean(name, "mean_deg")
        assert scores.calibration[name].rows[:, 0].sum() == sum(case.graph.num_edges for case in cases)


def test_ratios_are_of_the_same_cases(cases: list[Case]) -> None:
    def only_first(case: Case) -> Answer | None:
        return answer(case, case.truth, seconds=2.0) if case.key.name == "0" else None

    def always(case: Case) -> Answer:
        return answer(case, case.truth, seconds=1.0 if case.key.name == "0" else 9.0)

    scores = score_all(cases, {"first": only_first, "always": always})
    assert scores.ratio("first", "always", "cpu_seconds") == 2
    assert scores.mean("always", "cpu_seconds") == 5
    assert np.isnan(scores.mean("nobody", "cpu_seconds"))
    assert scores.ratios("first", "always", "cpu_seconds") == {cases[0].key: 2}


def test_scores_of_folds_add_up(cases: list[Case]) -> None:
    chosen = contenders(("spt",), ROSTER)
    whole, parts = score_all(cases, chosen), Scores()
    for case in cases:
        parts.extend(score_all([case], chosen))
    assert [row.mean_deg for row in parts.rows] == [row.mean_deg for row in whole.rows]
    np.testing.assert_array_equal(parts.calibration["spt"].rows, whole.calibration["spt"].rows)


def test_unknown_contender_lists_the_choices() -> None:
    with pytest.raises(UserError, match=r"unknown method 'magic'; choose from neurora, .*colmap"):
        contenders(("spt+magic",), ROSTER)


def test_an_interrupted_run_keeps_the_cases_that_all_have_solved(cases: list[Case]) -> None:
    calls = []

    def interrupted(case: Case) -> Answer:
        calls.append(case.key.name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return answer(case, case.truth)

    chosen = {**contenders(["spt"], ROSTER), "interrupted": interrupted}
    scores = score_all(cases, chosen)
    assert [(row.case.name, row.contender) for row in scores.rows] == [("0", "spt"), ("0", "interrupted")]
    assert scores.interrupted
    assert scores.calibration["spt"].rows[:, 0].sum() == cases[0].graph.num_edges


def test_where() -> None:
    def row(name: str, kind: str, contender: str) -> Score:
        return Score(CaseKey(name, kind), contender, 1.0, 1.0, 1.0, OutlierCounts(1, 0, 0, 1), 1.0, 0, 1.0)

    scores = Scores([row(name, kind, "x") for name in "ab" for kind in ("one", "two")] + [row("a", "one", "y")])
    assert (scores.names, scores.kinds, scores.contenders) == (("a", "b"), ("one", "two"), ("x", "y"))
    assert len(scores.where("x", names=["b"], kind="two").rows) == 1
    assert scores.where(cases=[CaseKey("a", "one")]).contenders == ("x", "y")
    assert scores.where("x").counts() == OutlierCounts(4, 0, 0, 4)
    assert not scores.where("nobody").rows


def test_geometric_mean() -> None:
    assert geometric_mean([1, 4]) == pytest.approx(2)
    assert np.isnan(geometric_mean([]))


def test_what_is_near_the_border_or_odometry_does_not_count_in_verdicts() -> None:
    """A robot's graph: noise of 0, 5, 9, 11, 13 and 50 degrees; the first edge is odometry."""
    noise_deg = torch.tensor([50.0, 0.0, 5.0, 9.0, 11.0, 13.0]).double()
    turns = rotations.exp(torch.stack((0 * noise_deg, 0 * noise_deg, torch.deg2rad(noise_deg)), dim=1))
    graph = ViewGraph.create([0] * 6, [1, 1, 1, 1, 1, 1], turns, kind=[0, 1, 1, 1, 1, 1])
    case = Case(CaseKey("six edges"), graph, rotations.identity(2), SLAM)
    flagged = answer(case, case.truth, score=torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0, 1.0]))
    scored = score(case, "made up", flagged)
    assert scored.counts == OutlierCounts(1, 1, 0, 1)
    assert scored.odometry_flagged == 1
    assert case.is_inlier.tolist() == [True, True, True, True, False, False]
    assert scored.floored_deg == 0
