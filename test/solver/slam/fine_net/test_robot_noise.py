"""What a robot's run tells of how it errs, against what it was drawn with."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.solver.learning.robot_runs import RobotRun
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.fine_net.features import FineFeatures
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet

EVEN = RobotFamily(
    ("building",), uneven=0, level=0, single=0, turns=0, speed=0, qualities=0, heavy=0, common=0, stated=0, even=0
)
USUAL = replace(
    EVEN,
    odometry_deg=(0.4, 0.4),
    closure_deg=(1.2, 1.2),
    closures_per_keyframe=(0.5, 0.5),
    false_share=(0.2, 0.2),
    grouped_share=0,
)
UNEVEN = replace(USUAL, uneven=1, uneven_factor=(8, 8), uneven_steps=(30, 30), odometry_deg=(0.2, 0.2))


@cache
def run_of(family: RobotFamily, seed: int, knows_truth: bool = False) -> tuple[DrawnGraph, RobotRun]:
    drawn = family.drawn(400, np.random.default_rng(seed))
    truth = torch.from_numpy(drawn.body_from_world) if knows_truth else None
    return drawn, RobotRun.of(drawn.graph, truth)


@pytest.mark.parametrize("knows_truth", [False, True])
@pytest.mark.parametrize("seed", [1])
def test_noise_is_what_was_drawn(seed: int, knows_truth: bool) -> None:
    drawn, run = run_of(USUAL, seed, knows_truth)
    noise = run.noise()
    assert noise.planar == drawn.planar
    assert noise.odometry_deg == pytest.approx(0.4, rel=0.3)
    assert noise.closure_deg == pytest.approx(1.2, rel=0.3)
    assert noise.false_share == pytest.approx(drawn.is_false[drawn.is_closure].mean(), abs=0.05)
    assert noise.closures_per_keyframe == pytest.approx(drawn.is_closure.sum() / 400, abs=0.01)
    assert noise.step_spread < 0.3


def test_uneven_odometry_shows() -> None:
    even, uneven = (
        np.mean([run_of(family, seed)[1].noise().step_spread for seed in (1, 2)]) for family in (USUAL, UNEVEN)
    )
    assert uneven > even + 0.2


def test_errors_in_turns_show_by_the_truth() -> None:
    turning = replace(USUAL, turns=1, per_turn=(0.08, 0.08), odometry_deg=(0.1, 0.1))
    _drawn, run = run_of(turning, 3, True)
    noise = run.noise()
    assert noise.per_turn == pytest.approx(0.08, rel=0.4)
    assert run_of(USUAL, 1, True)[1].noise().per_turn < 0.03


def test_what_turns_add_is_not_counted_again_as_a_steps_own_error() -> None:
    """Runs are simulated with both, so that they erred three times as much as the robot's."""
    turning = replace(USUAL, turns=1, per_turn=(0.1, 0.1), odometry_deg=(0.3, 0.3))
    for knows_truth in (False, True):
        found = [run_of(turning, seed, knows_truth)[1].noise().odometry_deg for seed in (1, 2, 3)]
        assert 0.3 / 2 < np.median(found) < 0.3 * 2, found
        assert max(found) < 0.3 * 2.5, found


def test_false_closures_that_agree_show() -> None:
    grouped = replace(USUAL, grouped_share=1.0)
    assert run_of(grouped, 4)[1].noise().grouped_share > 0.8
    for planar in (0.0, 1.0):
        assert run_of(replace(USUAL, planar_share=planar), 4)[1].noise().grouped_share < 0.5


@pytest.mark.large
def test_held_back_stretches_tell_a_network_from_one_that_says_the_opposite() -> None:
    package = Networks("cpu").load(SlamFineNet)
    opposite = _Opposite(package)
    rows = np.concatenate([run_of(UNEVEN, seed)[1].explained([package, opposite]) for seed in (4, 5)])
    assert len(rows) > 10
    assert (rows[:, 0] - rows[:, 1]).mean() > 0


class _Opposite(SlamFineNet):
    """Where the other one says that edges err by more they err by less."""

    def __init__(self, other: SlamFineNet) -> None:
        super().__init__()
        self.load_state_dict(other.state_dict())
        self.eval()

    def forward(self, features: FineFeatures) -> Tensor:
        return -super().forward(features)


def test_the_same_network_explains_the_same() -> None:
    rows = run_of(USUAL, 1)[1].explained([SlamFineNet().eval(), SlamFineNet().eval(), None])
    np.testing.assert_array_equal(rows[:, 0], rows[:, 1])
    np.testing.assert_allclose(rows[:, 0], rows[:, 2], atol=0.1)
