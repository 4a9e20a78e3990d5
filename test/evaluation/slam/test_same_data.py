"""A slip and false closures that are the same data: what is counted against either truth."""

from __future__ import annotations

import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, drawings
from rotavg_ros.evaluation.slam import stress
from rotavg_ros.evaluation.slam.same_data import Mixture, SameData, if_false, table


def a_case(witnesses: int) -> Case:
    (case,) = drawings(stress.kinds([f"{witnesses} witnesses, one pair"]), [0])
    return case


def stated(case: Case, score: float, degrees: float = 1.0) -> Answer:
    """The truth, with that score of all edges and that uncertainty of all nodes."""
    uncertainty = torch.full((case.graph.num_nodes,), degrees, dtype=torch.float64).deg2rad()
    return Answer(case.truth, 0.0, 0.0, torch.full((case.graph.num_edges,), score), uncertainty)


@pytest.fixture(scope="module", params=[5, 10], ids=["in the plane", "in space"])
def slipped(request: pytest.FixtureRequest) -> Case:
    return a_case(request.param)


def test_if_its_closures_are_false_odometry_is_sound(slipped: Case) -> None:
    other, odometry = if_false(slipped), slipped.graph.is_odometry
    assert int((slipped.noise[odometry] > 0.2).sum()) == 1  # rad
    assert float(other.noise[odometry].max()) < 0.1
    assert not slipped.is_false.any()
    across = other.is_false
    assert int(across.sum()) == int(slipped.key.kind.split()[2])
    torch.testing.assert_close(other.noise[~across & ~odometry], slipped.noise[~across & ~odometry])


def test_what_was_measured_is_the_same_and_only_the_truth_differs(slipped: Case) -> None:
    other = if_false(slipped)
    assert other.graph is slipped.graph
    turned = rotations.multiply(rotations.inverse(slipped.truth), other.truth)
    angles = rotations.angle(turned)
    first = int(torch.nonzero(angles > 0.2)[0])
    assert float(angles[:first].max()) < 1e-6
    assert float(angles[first:].max() - angles[first:].min()) < 1e-6


@pytest.mark.parametrize(("score", "error", "sure"), [(0.5, 0.0, 0.0), (0.0, 0.5, 1.0), (0.9, 0.4, 0.0)])
def test_one_half_is_right_of_what_nobody_can_know(slipped: Case, score: float, error: float, sure: float) -> None:
    answer = stated(slipped, score)
    mixture = Mixture()
    mixture.add(slipped, answer)
    assert mixture.scores.error == pytest.approx(error)
    assert mixture.num_sure == sure * mixture.num_witnesses


def test_an_uncertainty_may_cover_either_truth(slipped: Case) -> None:
    mixtures = {}
    for degrees in (0.1, 180.0):
        mixtures[degrees] = mixture = Mixture()
        mixture.add(slipped, stated(slipped, 0.5, degrees))
        assert mixture.if_slipped.within_two == mixture.if_slipped.num_errors
    assert mixtures[0.1].if_false.within_two < mixtures[0.1].if_false.num_errors
    assert mixtures[180.0].if_false.within_two == mixtures[180.0].if_false.num_errors


def test_only_lone_slips_from_one_pair_are_counted() -> None:
    watcher = SameData()
    watched = watcher.watching(lambda case: stated(case, 0.5))
    cases = [*drawings(stress.kinds(["3 witnesses"]), [0])]
    for case in cases:
        watched(case)
    found = watcher.of_kinds([case.key for case in cases])
    assert list(found) == ["lone slip: 3 witnesses, one pair of places"]
    total, kind = table("", found).rows
    assert total[1:] == kind[1:]
    assert total[:2] == ("all", 1)
