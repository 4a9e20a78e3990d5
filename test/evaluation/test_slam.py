"""The SLAM suite on tiny graphs: what is drawn, how it is scored, what is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import norm

from rotavg_ros import rotations
from rotavg_ros.datasets.files.graph_file import GraphFile, write_graph
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation import slam_cases, slam_contenders, slam_incremental, slam_report, slam_uncertainty
from rotavg_ros.evaluation.least_squares import least_squares
from rotavg_ros.evaluation.metrics import OutlierCounts
from rotavg_ros.evaluation.slam_contenders import SlamAnswer
from rotavg_ros.evaluation.slam_scoring import SlamScore, SlamScores, geometric_mean, good_flagged, score, score_all
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import ViewGraph

NUM_NODES, LAP = 120, 30


def laps(step_deg: float = 0.1, closure_deg: float = 0.5) -> GraphFile:
    """Planar laps with a closure to the lap before at every second keyframe."""
    rng = np.random.default_rng(0)
    later = np.arange(LAP, NUM_NODES, 2)
    source = np.concatenate((np.arange(NUM_NODES - 1), later - LAP))
    target = np.concatenate((np.arange(1, NUM_NODES), later))
    sigma = np.repeat(np.radians([step_deg, closure_deg]), (NUM_NODES - 1, len(later)))
    turn = -2 * np.pi * (target - source) / LAP + sigma * rng.normal(size=len(source))
    vector = torch.from_numpy(np.stack((0 * turn, 0 * turn, turn), axis=1))
    kind = (np.arange(len(source)) >= NUM_NODES - 1).astype(int)
    rotation = rotations.exp(vector).numpy()
    return GraphFile.from_ids(source, target, rotation, kind=kind, precision=sigma**-2, planar=True)


def spoiled(condition: str = "30 % random", share: float = 0.3, seed: int = 0) -> slam_cases.SlamCase:
    return slam_cases.spoiled_case("laps", laps(), condition, share, seed)


def test_the_same_seed_draws_the_same_case() -> None:
    a, b, c = spoiled(seed=1), spoiled(seed=1), spoiled(seed=2)
    torch.testing.assert_close(a.graph.target_from_source, b.graph.target_from_source)
    assert not torch.equal(a.graph.target_from_source, c.graph.target_from_source)


def test_false_good_and_undecided_closures() -> None:
    case = spoiled()
    closures = int(case.is_closure.sum())
    assert (~case.is_inlier).sum() == round(0.3 * closures)
    assert not (case.is_false & case.is_good).any()
    assert not (case.is_false & case.is_inlier).any()
    assert (case.is_good == (case.is_closure & case.is_inlier)).all()


def test_slips_are_odometry_and_the_oracle_leaves_them_out() -> None:
    case = slam_cases.spoiled_case("laps", laps(), slam_cases.SLIPS, 0.3, 0)
    slipped = ~case.is_inlier & ~case.is_closure
    assert slipped.sum() == 1
    assert np.degrees(case.noise[slipped]).min() > 19
    oracle = slam_contenders.contenders(["oracle"])["oracle"](case)
    assert oracle is not None
    assert score(case, "oracle", oracle).error_deg < 0.5


def test_the_reference_of_a_clean_graph_is_least_squares() -> None:
    case = spoiled("0 % random", 0.0)
    answer = slam_contenders.contenders(["least-squares"])["least-squares"](case)
    assert answer is not None
    scored = score(case, "least-squares", answer)
    assert scored.error_deg < 1e-4
    assert scored.floored_deg == pytest.approx(0.3)


def test_scores() -> None:
    case = spoiled()
    is_outlier = case.is_false.copy()
    is_outlier[np.flatnonzero(case.is_good)[0]] = True
    is_outlier[np.flatnonzero(case.is_false)[0]] = False
    is_outlier[0] = True  # an odometry edge
    turned = rotations.multiply(case.truth, rotations.random(1, generator=torch.Generator().manual_seed(0)))
    scored = score(case, "made up", SlamAnswer(turned, is_outlier, 1.0))
    assert scored.error_deg < 1e-5  # whatever the gauge
    assert scored.counts.false_positives == 1
    assert scored.counts.false_negatives == 1
    assert scored.counts.true_positives == case.is_false.sum() - 1
    assert scored.odometry_flagged == 1
    assert good_flagged(scored.counts) == pytest.approx(1 / case.is_good.sum())


def test_ratios_are_of_the_same_case() -> None:
    def row(case: str, contender: str, error: float) -> SlamScore:
        counts = OutlierCounts(0, 0, 0, 1)
        return SlamScore(case, "g", "c", 0, contender, error, max(error, 0.3), counts, 0, error)

    scores = SlamScores((row("1", "oracle", 0.1), row("1", "x", 0.6), row("2", "x", 9.0), row("3", "oracle", 1.0)))
    assert scores.ratios("x", ["g"]) == {"1": pytest.approx(2.0)}
    assert geometric_mean([1, 4]) == pytest.approx(2)
    assert np.isnan(geometric_mean([]))


def test_incremental_run_ends_like_the_batch_solve() -> None:
    case = spoiled()
    run = slam_incremental.play(case)
    assert run.keyframes.tolist() == list(range(10, NUM_NODES + 1, 10))
    assert run.false_seen[-1] == case.is_false.sum()
    assert run.good_seen[-1] == case.is_good.sum()
    batch = slam_contenders.contenders(["neurora"])["neurora"](case)
    assert batch is not None
    assert run.error_deg[-1] == pytest.approx(score(case, "neurora", batch).error_deg, abs=0.1)
    assert np.isnan(run.worst_excess_deg)  # a short run settles nothing


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_normalized_error_is_error_over_stated(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    graph_file = laps()
    truth = least_squares(graph_file.graph, np.ones(graph_file.graph.num_edges, dtype=bool))
    stated = torch.linspace(0, 0.1, NUM_NODES).double()
    generator = torch.Generator().manual_seed(0)

    def solver(graph: ViewGraph, profile: str) -> Solution:
        yaw = factor * stated * torch.randn(NUM_NODES, generator=generator).double()
        error = rotations.exp(torch.stack((0 * yaw, 0 * yaw, yaw), dim=1))
        component = torch.zeros(NUM_NODES, dtype=torch.int64)
        estimate = rotations.multiply(truth, error)
        return Solution(estimate, torch.zeros(graph.num_edges), component, stated, {}, "made up", profile, "cpu")

    monkeypatch.setattr(slam_uncertainty, "solve", solver)
    checks = list(slam_uncertainty.check("laps", graph_file, 20, seed=0))
    assert [check.step_deg for check in checks] == [step for step, _ in slam_uncertainty.NOISE_DEG]
    for check in checks:
        assert check.normalized_error == pytest.approx(factor, rel=0.06)
        assert check.within_one == pytest.approx(2 * norm.cdf(1 / factor) - 1, abs=0.03)


def test_report(tmp_path: Path) -> None:
    names = ["neurora", "odometry", "oracle"]
    chosen = slam_contenders.contenders(names)
    cases = [spoiled(), spoiled("0 % random", 0.0), spoiled(slam_cases.GROUPED)]
    scores = score_all(cases, chosen)
    assert len(scores.rows) == len(cases) * len(names)
    report = slam_report.report(
        tmp_path,
        scores,
        [slam_incremental.play(cases[0])],
        [slam_uncertainty.UncertaintyCheck("laps", 0.1, 1.0, 1.1, 0.6, 0.9)],
        "rotavg evaluate slam",
    )
    text = report.read_text(encoding="utf-8")
    assert "error over the oracle's" in text
    written = {path.name for path in tmp_path.iterdir()}
    assert {"slam.md", "slam-cases.csv", "slam-ratios.csv", "slam-ratios.png", "slam-incremental-laps.png"} <= written
    assert len((tmp_path / "slam-cases.csv").read_text().splitlines()) == 1 + len(scores.rows)


def test_graphs_come_from_the_data_folder(tmp_path: Path) -> None:
    (tmp_path / "slam").mkdir()
    write_graph(tmp_path / "slam" / "CSAIL.g2o", laps())
    drawn = list(slam_cases.cases(tmp_path, ["CSAIL", "CSAIL"], [0.0, 0.5, 0.5], [3, 4, 3]))
    conditions = [(case.condition, case.seed) for case in drawn]
    assert conditions[:3] == [("0 % random", 3), ("50 % random", 3), ("50 % random", 4)]
    # Laps that are tied together all along locate a slip but for which of them slipped: not every draw has a place.
    hard = (slam_cases.GROUPED, slam_cases.SLIPS, slam_cases.LOCATABLE_SLIPS)
    assert set(conditions[3:7]) == {(condition, seed) for condition in hard[:2] for seed in (3, 4)}
    assert set(conditions[7:]) <= {(hard[2], seed) for seed in (3, 4)}


@pytest.mark.parametrize("graphs", [["CSAIL"], ["nowhere"]])
def test_what_is_missing_is_told(tmp_path: Path, graphs: list[str]) -> None:
    with pytest.raises(UserError, match=r"lacks slam|unknown graph 'nowhere'"):
        list(slam_cases.cases(tmp_path, graphs, [0.0], [0]))


def test_unknown_contender() -> None:
    with pytest.raises(UserError, match="unknown method 'magic'"):
        slam_contenders.contenders(["magic"])


def test_b25b_oracle(shared_data: Path) -> None:
    case = next(slam_cases.cases(shared_data, ["B25b_0.000"], [], [0]))
    closures = case.is_closure & np.isfinite(case.noise)
    assert closures.sum() == 390
    assert (case.noise[closures] > np.radians(10)).sum() == 90
    oracle = slam_contenders.contenders(["oracle"])["oracle"](case)
    assert oracle is not None
    assert score(case, "oracle", oracle).error_deg == pytest.approx(2.33, abs=0.01)
