"""Seconds of a tick as units of work."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from rotavg_ros.ros.node.tick_budget import TickBudget
from rotavg_ros.solver import SECONDS_PER_UNIT


def test_units_go_by_what_ticks_have_cost() -> None:
    budget = TickBudget()
    assert budget.units(0.2) == pytest.approx(0.2 / SECONDS_PER_UNIT) == 400.0  # before any has told
    for seconds in (0.4, 0.5, 30.0):  # once the machine was asleep
        budget.learn(seconds, 100.0)
    assert budget.units(0.2) == pytest.approx(40.0)
    budget.learn(1.0, 1.0)  # a tick that hardly solved
    assert budget.units(0.2) == pytest.approx(40.0)
    for _ in range(50):
        budget.learn(0.05, 100.0)
    assert budget.units(0.2) == pytest.approx(400.0)


def test_a_slow_first_tick_does_not_slow_down_for_good() -> None:
    """The rest of the work comes in pieces as small as the budget allows, so these have to count."""
    budget = TickBudget()
    budget.learn(10.0, 100.0)  # it has compiled
    assert budget.units(0.2) == pytest.approx(2.0)
    for _ in range(10):
        budget.learn_rest(1e-4, 0.0)  # nothing was left to do
        budget.learn_rest(0.001 * budget.units(0.2), budget.units(0.2))
    assert budget.units(0.2) == pytest.approx(200.0)
