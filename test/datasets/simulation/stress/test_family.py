"""The family of runs with uneven noise: what is drawn errs as it says, and what cannot be drawn is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rotavg_ros.datasets.simulation.stress.family import RobotFamily, RobotFamilyError
from rotavg_ros.datasets.worlds import World

EVEN = RobotFamily(uneven=0, level=0, single=0, turns=0, speed=0, qualities=0, heavy=0, common=0, stated=0, even=0)


@pytest.mark.parametrize("seed", range(6))
def test_errors_have_the_stated_variances(seed: int) -> None:
    """Squares of true errors over their variances are one in the mean, whatever is uneven."""
    drawn = RobotFamily(common=0, false_share=(0, 0)).drawn(400, np.random.default_rng(seed))
    components = 1 if drawn.planar else 3
    error = drawn.error.as_rotvec() / drawn.sigma[:, None]
    for kind in (drawn.is_closure, ~drawn.is_closure):
        square = (error[kind] ** 2).sum(axis=1)
        assert square.mean() == pytest.approx(components, abs=5 * np.sqrt(2 * components / kind.sum()))


def test_even_noise_is_as_asked_for() -> None:
    family = replace(EVEN, odometry_deg=(0.4, 0.4), closure_deg=(1.5, 1.5), false_share=(0.3, 0.3))
    drawn = family.drawn(300, np.random.default_rng(1))
    axes = 1 if drawn.planar else 3
    for kind, degrees in ((~drawn.is_closure, 0.4), (drawn.is_closure, 1.5)):
        np.testing.assert_allclose(np.degrees(drawn.sigma[kind]) * np.sqrt(axes), degrees)
    assert (drawn.is_wrong & drawn.is_closure).sum() / drawn.is_closure.sum() == pytest.approx(0.3, abs=0.02)


def test_speed_lengthens_steps_where_they_err_more() -> None:
    drawn = replace(EVEN, speed=1).drawn(400, np.random.default_rng(2))
    assert drawn.graph.translation is not None
    odometry = ~drawn.is_closure
    length = np.linalg.norm(drawn.edge_translation[odometry], axis=1)
    assert np.corrcoef(np.log(length + 1e-9), np.log(drawn.sigma[odometry]))[0, 1] > 0.5


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"worlds": ["moon"]}, "worlds is .'moon'.; choose some of .*building"),
        ({"odometry_deg": [0.5, 0.1]}, "odometry_deg is .0.5, 0.1.; use an ascending pair between 0.001 and 20"),
        ({"false_share": [0, 1]}, "false_share is .* between 0 and 0.9"),
        ({"planar_share": 2}, "planar_share is 2.0; use a number between 0 and 1"),
        ({"odometry_deg": "far"}, "odometry_deg is 'far', expected like"),
        # A text's letters and a mapping's keys are no list, and `true` is no number.
        ({"odometry_deg": "12"}, "odometry_deg is '12', expected like"),
        ({"odometry_deg": {0.1: "low", 0.4: "high"}}, "odometry_deg is {.*, expected like"),
        ({"odometry_deg": [True, True]}, "odometry_deg is .True, True., expected like"),
        ({"worlds": "building"}, "worlds is 'building', expected like"),
        ({"even": True}, "even is True, expected like"),
        ({"noise": 1}, "unknown key 'noise'; known are worlds, planar_share"),
        (["worlds"], "expected `key: value` lines, found list"),
    ],
)
def test_what_cannot_be_drawn_is_refused(content: object, message: str) -> None:
    with pytest.raises(RobotFamilyError, match=message):
        RobotFamily.of(content)


def test_plain_values_make_the_family_that_they_name() -> None:
    told = {"worlds": ["grid"], "planar_share": 1, "closure_deg": [1, 2]}
    assert RobotFamily.of(told) == RobotFamily(worlds=(World.GRID.value,), planar_share=1.0, closure_deg=(1.0, 2.0))
