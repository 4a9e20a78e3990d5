"""What the SLAM suite draws, and what is known of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.common.scoring import score
from rotavg_ros.evaluation.slam import cases

from ..laps import answer_of, laps, spoiled


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
    case = spoiled(cases.SLIPS)
    slipped = ~case.is_inlier & ~case.is_closure
    assert slipped.sum() == 1
    assert float(torch.rad2deg(case.noise[slipped]).min()) > 19
    assert score(case, "oracle", answer_of("oracle", case)).mean_deg < 0.5


def test_the_reference_of_a_clean_graph_is_least_squares() -> None:
    case = spoiled("0 % random", 0.0)
    scored = score(case, "least-squares", answer_of("least-squares", case))
    assert scored.mean_deg < 1e-4
    assert scored.floored_deg == pytest.approx(0.3)


def test_scores() -> None:
    case = spoiled()
    is_outlier = case.is_false.clone()
    is_outlier[case.is_good.nonzero()[0]] = True
    is_outlier[case.is_false.nonzero()[0]] = False
    is_outlier[0] = True  # an odometry edge
    turned = rotations.multiply(case.truth, rotations.random(1, generator=torch.Generator().manual_seed(0)))
    scored = score(case, "made up", Answer(turned, 1.0, 1.0, is_outlier.double()))
    assert scored.mean_deg < 1e-5  # whatever the gauge
    assert scored.counts.false_positives == 1
    assert scored.counts.false_negatives == 1
    assert scored.counts.true_positives == case.is_false.sum() - 1
    assert scored.odometry_flagged == 1
    assert scored.counts.false_alarm_rate == pytest.approx(1 / int(case.is_good.sum()))


def test_graphs_come_from_the_data_folder(tmp_path: Path) -> None:
    (tmp_path / "slam").mkdir()
    write_graph(tmp_path / "slam" / "CSAIL.g2o", laps())
    drawn = drawings(cases.kinds(tmp_path, ["CSAIL", "CSAIL"], [0.0, 0.5, 0.5]), [3, 4])
    conditions = [(case.key.kind, case.key.seed) for case in drawn]
    assert conditions[:3] == [("0 % random", 3), ("50 % random", 3), ("50 % random", 4)]
    # Laps that are tied together all along locate a slip but for which of them slipped: not every draw has a place.
    hard = (cases.GROUPED, cases.SLIPS, cases.LOCATABLE_SLIPS)
    assert set(conditions[3:7]) == {(condition, seed) for condition in hard[:2] for seed in (3, 4)}
    assert set(conditions[7:]) <= {(hard[2], seed) for seed in (3, 4)}


@pytest.mark.parametrize("graphs", [["CSAIL"], ["nowhere"]])
def test_what_is_missing_is_told(tmp_path: Path, graphs: list[str]) -> None:
    with pytest.raises(UserError, match=r"lacks slam|unknown graph 'nowhere'"):
        cases.kinds(tmp_path, graphs, [0.0])


def test_b25b_oracle(shared_data: Path) -> None:
    case = next(drawings(cases.kinds(shared_data, ["B25b_0.000"], []), [0]))
    closures = case.is_closure & torch.isfinite(case.noise)
    assert closures.sum() == 390
    assert (case.noise[closures] > np.radians(10)).sum() == 90
    assert score(case, "oracle", answer_of("oracle", case)).mean_deg == pytest.approx(2.33, abs=0.01)


def test_what_was_recorded_is_also_judged_from_its_beginnings(shared_data: Path) -> None:
    kinds = cases.kinds(shared_data, ["B25b_0.000"], [])
    assert [kind.name for kind in kinds] == [cases.AS_RECORDED, *cases.BEGINNINGS]
    whole, early = kinds[0].draw(0), kinds[1].draw(0)
    assert whole is not None and early is not None
    count = round(0.2 * whole.graph.num_nodes)
    assert early.graph.num_nodes == len(early.truth) == count
    newest = torch.maximum(whole.graph.source, whole.graph.target)
    assert early.graph.num_edges == int((newest < count).sum())
    torch.testing.assert_close(early.truth, whole.truth[:count], equal_nan=True)
