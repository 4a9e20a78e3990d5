from __future__ import annotations

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import ReleasedRecipe
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.calibration import CalibrationBins, expected_calibration_error
from rotavg_ros.evaluation.contenders import Answer, Case, contenders, warm_up
from rotavg_ros.evaluation.scoring import Scores, roc_area, score, score_all


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    rng = np.random.default_rng(0)
    samples = [ReleasedRecipe(cameras=(40, 60)).sample(rng) for _ in range(2)]
    return [Case(str(number), sample.graph, sample.body_from_world) for number, sample in enumerate(samples)]


def test_roc_area_counts_pairs_in_the_right_order() -> None:
    value, is_positive = np.array([0.1, 0.4, 0.4, 0.9]), np.array([False, True, False, True])
    assert roc_area(value, is_positive) == pytest.approx((1 + 0.5 + 1 + 1) / 4)
    assert np.isnan(roc_area(value, np.zeros(4, dtype=bool)))


def test_truth_in_another_gauge_scores_zero_degrees(cases: list[Case]) -> None:
    case = cases[0]
    turned = rotations.multiply(case.truth, rotations.random(1, generator=torch.Generator().manual_seed(1)))
    known = score(case, "truth", Answer(turned, (case.noise_angle > np.radians(20)).double(), 0.5))
    assert known.mean_deg == pytest.approx(0, abs=1e-4)
    assert (known.accuracy, known.precision, known.recall, known.roc_area, known.cpu_seconds) == (1, 1, 1, 1, 0.5)


def test_error_of_one_orientation_is_its_angle(cases: list[Case]) -> None:
    case = cases[0]
    wrong = case.truth.clone()
    wrong[3] = rotations.multiply(wrong[3], rotations.exp(torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)))
    errors = score(case, "wrong", Answer(wrong, torch.zeros(case.graph.num_edges), 0.0))
    assert errors.mean_deg == pytest.approx(np.degrees(0.5) / len(wrong), rel=1e-3)
    assert errors.median_deg == pytest.approx(0, abs=1e-3)
    assert errors.recall == 0


def test_every_contender_runs_and_the_oracle_leads(cases: list[Case]) -> None:
    pytest.importorskip("pycolmap")
    pytest.importorskip("gtsam")
    names = ("neurora", "neurora-unweighted", "neurora-without-finenet", "spt+chatterjee", "colmap", "shonan", "oracle")
    chosen = contenders(names)
    warm_up(tuple(chosen.values()))
    scores = score_all(cases, chosen)
    assert [(row.case, row.contender) for row in scores.rows] == [(case.name, name) for case in cases for name in names]
    for name in set(names) - {"oracle"}:
        assert scores.mean("oracle", "mean_deg") <= 1.1 * scores.mean(name, "mean_deg")
        assert scores.calibration[name].rows[:, 0].sum() == sum(case.graph.num_edges for case in cases)


def test_ratios_are_of_the_same_cases(cases: list[Case]) -> None:
    def only_first(case: Case) -> Answer | None:
        return Answer(case.truth, torch.zeros(case.graph.num_edges), 2.0) if case.name == "0" else None

    def always(case: Case) -> Answer:
        return Answer(case.truth, torch.zeros(case.graph.num_edges), 1.0 if case.name == "0" else 9.0)

    scores = score_all(cases, {"first": only_first, "always": always})
    assert scores.ratio("first", "always", "cpu_seconds") == 2
    assert scores.mean("always", "cpu_seconds") == 5
    assert np.isnan(scores.mean("nobody", "cpu_seconds"))


def test_scores_of_folds_add_up(cases: list[Case]) -> None:
    chosen = contenders(("spt",))
    whole, parts = score_all(cases, chosen), Scores()
    for case in cases:
        parts.extend(score_all([case], chosen))
    assert [row.mean_deg for row in parts.rows] == [row.mean_deg for row in whole.rows]
    np.testing.assert_array_equal(parts.calibration["spt"].rows, whole.calibration["spt"].rows)


def test_unknown_contender_lists_the_choices() -> None:
    with pytest.raises(UserError, match=r"unknown method 'magic'; choose from neurora, .*colmap"):
        contenders(("spt+magic",))


def test_calibrated_scores_have_no_calibration_error() -> None:
    generator = torch.Generator().manual_seed(0)
    probability = torch.rand(200_000, generator=generator, dtype=torch.float64)
    happened = torch.rand(200_000, generator=generator) < probability
    assert expected_calibration_error(probability, happened) < 0.01
    assert expected_calibration_error(probability**3, happened) > 0.1


def test_bins_collect_what_is_added() -> None:
    bins = CalibrationBins()
    bins.add(torch.tensor([0.05, 0.95]), torch.tensor([False, True]))
    bins.add(torch.tensor([0.05, 1.0]), torch.tensor([True, True]))
    np.testing.assert_allclose(bins.rows, [[2, 0.05, 0.5], [2, 0.975, 1.0]])


def test_an_interrupted_run_keeps_the_cases_that_all_have_solved(cases: list[Case]) -> None:
    calls = []

    def interrupted(case: Case) -> Answer:
        calls.append(case.name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return Answer(case.truth, (case.noise_angle > np.radians(20)).double(), 0.0)

    chosen = {**contenders(["spt"]), "interrupted": interrupted}
    scores = score_all(cases, chosen)
    assert [(row.case, row.contender) for row in scores.rows] == [("0", "spt"), ("0", "interrupted")]
    assert scores.calibration["spt"].rows[:, 0].sum() == cases[0].graph.num_edges
