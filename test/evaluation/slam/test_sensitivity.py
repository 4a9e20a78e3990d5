"""What is said of priors that are halved and doubled."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.slam import sensitivity, stress
from rotavg_ros.evaluation.slam.sensitivity import Answer
from rotavg_ros.solver.diagnosis import SlamPriors, orientations_under


def test_one_prior_at_a_time_and_probabilities_stay_probabilities() -> None:
    usual = asdict(SlamPriors())
    seen = set()
    for name, factor, priors in sensitivity.variants():
        differs = {key: value for key, value in asdict(priors).items() if value != usual[key]}
        assert set(differs) == ({name} if name else set())
        assert all(value > 0 for value in differs.values())
        if name.endswith(("share", "errors")):
            assert 0 < differs[name] < 1
        seen.add((name, factor))
    assert len(seen) == 1 + 2 * len(usual)
    assert sensitivity.changed("turn_errors", 2.0).turn_errors == pytest.approx(2 / 3)
    assert sensitivity.changed("slip_deg", 0.5).slip_deg == pytest.approx(22.5)


def test_the_table_counts_what_moved() -> None:
    def case(of_slips: float) -> list[Answer]:
        return [
            Answer(name, factor, np.log(of_slips) if (name, factor) == ("slip_deg", 2.0) else 0.0)
            for name, factor, _ in sensitivity.variants()
        ]

    rows = {row[0]: row for row in sensitivity.table("Priors", [case(1.21), case(1.0)]).rows}
    assert rows["slip_deg"][2:] == (0.0, pytest.approx(10.0), 0, 1)
    assert rows["step_deg"][2:] == (0.0, 0.0, 0, 0)


def test_a_prior_changes_the_answer() -> None:
    case = next(drawings(stress.kinds(["building: 15 closures"]), [0]))
    usual = orientations_under(case.graph, SlamPriors())
    other = orientations_under(case.graph, sensitivity.changed("closure_deg", 0.5))
    assert not np.allclose(usual.numpy(), other.numpy(), atol=1e-6)
