"""The stress suite's cases: which there are, and what the oracle knows."""

from __future__ import annotations

import pytest
import torch

from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.common.scoring import score
from rotavg_ros.evaluation.slam import stress

from ..laps import answer_of


def test_kinds_by_parts_of_their_names() -> None:
    everything = stress.kinds()
    assert [kind.name for kind in stress.kinds(["ROBOTS: half"])] == [f"{n} robots: half random" for n in (2, 3, 8)]
    both = stress.kinds(["grid", "15 closures"])
    assert [kind.name for kind in both] == [
        kind.name for kind in everything if "grid" in kind.name or "15 closures" in kind.name
    ]
    with pytest.raises(
        stress.StressSuiteError, match=r"no kind's name contains 'nowhere'; names begin with building, "
    ):
        stress.kinds(["grid", "nowhere"])


def test_a_case_says_what_is_true_of_it() -> None:
    (case,) = drawings(stress.kinds(["building: locatable"]), [0])
    assert case.key.name == "building"
    slips = ~case.is_inlier & ~case.is_closure
    assert slips.any()
    assert not (case.is_false & case.is_inlier).any()
    assert case.true_precision is not None


def test_ablation_cases_are_tuning_seeds_of_every_kind() -> None:
    cases = stress.ablation_cases()
    first = [next(cases).key for _ in range(4)]
    assert [key.seed for key in first] == [0, 1, 2, 0]
    assert len({key.kind for key in first}) == 2


SOLVED = [kind for kind in stress.kinds() if "15 000" not in kind.name]


# Every sixth kind by default.
@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, id=kind.name, marks=pytest.mark.large if number % 6 else ())
        for number, kind in enumerate(SOLVED)
    ],
)
def test_the_oracle_is_near_the_truth(kind: object) -> None:
    case = kind.draw(0)  # type: ignore[attr-defined]
    answer = answer_of("oracle", case)
    mean_deg = score(case, "oracle", answer).mean_deg
    # Half of what its own edges err by at most, or what a drift between few closures leaves.
    assert mean_deg < (8 if "4° steps" in case.key.kind or "drift" in case.key.kind else 5)
    assert torch.isfinite(answer.body_from_world).all()


def test_the_oracle_knows_precisions() -> None:
    """Of closures of two qualities, which state one, and of odometry that is worse at times."""
    errors = {"oracle": 0.0, "inliers": 0.0}
    for case in drawings(stress.kinds(["uneven odometry"]), [0, 1]):
        errors["oracle"] += score(case, "oracle", answer_of("oracle", case)).mean_deg
        blind = type(case)(case.key, case.graph, case.truth, case.family, case.intact, case.floor)
        errors["inliers"] += score(blind, "oracle", answer_of("oracle", blind)).mean_deg
    assert errors["oracle"] < 0.9 * errors["inliers"]
