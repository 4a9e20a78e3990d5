"""Cases, and the kinds that they are drawn from."""

from __future__ import annotations

import torch

from rotavg_ros import rotations
from rotavg_ros.evaluation.common.cases import (
    SFM,
    SLAM,
    Case,
    CaseKey,
    Family,
    Kind,
    drawings,
    num_drawings,
    warm_up_case,
)
from rotavg_ros.view_graph import ViewGraph


def triangle(family: Family, *, intact: torch.Tensor | None = None) -> Case:
    """A step of odometry that is off by 90 degrees, a closure off by 15 and one that is right."""
    turns = rotations.exp(torch.tensor([[0, 0, 90.0], [0, 15.0, 0], [0, 0, 0]]).double().deg2rad())
    graph = ViewGraph.create([0, 1, 0], [1, 2, 2], turns, kind=[0, 1, 1])
    return Case(CaseKey("triangle"), graph, rotations.identity(3), family, intact)


def test_what_is_false_depends_on_the_family() -> None:
    robots, photographs = triangle(SLAM), triangle(SFM)
    assert torch.rad2deg(robots.noise).round().tolist() == [90, 15, 0]
    assert robots.is_inlier.tolist() == [True, False, True]
    assert (robots.is_false.tolist(), robots.is_good.tolist()) == ([False, True, False], [False, False, True])
    assert photographs.is_inlier.tolist() == [False, True, True]
    assert (photographs.is_false.tolist(), photographs.is_good.tolist()) == ([True, False, False], [False, True, True])


def test_whoever_spoiled_a_graph_knows_what_was_left() -> None:
    case = triangle(SLAM, intact=torch.tensor([False, True, False]))
    assert case.is_inlier.tolist() == [False, True, False]
    # Right by chance: neither good nor false.
    assert not bool((case.is_good | case.is_false)[2])


def test_edges_of_unknown_truth_are_neither_good_nor_false() -> None:
    case = triangle(SFM)
    case.truth[2] = torch.nan
    assert (case.is_false | case.is_good).tolist() == [True, False, False]


def test_drawings() -> None:
    drawn = []

    def draw(seed: int) -> Case | None:
        drawn.append(seed)
        return None if seed == 1 else warm_up_case(SLAM)

    found = list(drawings([Kind("random", draw), Kind("recorded", draw, is_random=False)], [0, 1, 2]))
    assert drawn == [0, 1, 2, 0]
    assert len(found) == 3
    assert not list(drawings([], [0]))
    # Of a seed that is named twice there is one case, or its verdicts would count twice.
    drawn.clear()
    random = [Kind("random", draw)]
    assert len(list(drawings(random, [2, 0, 2]))) == num_drawings(random, [2, 0, 2]) == 2
    assert drawn == [2, 0]


def test_names() -> None:
    assert str(CaseKey("intel", "30 % random", 2)) == "intel, 30 % random, seed 2"
    assert str(CaseKey("Lund")) == "Lund"
