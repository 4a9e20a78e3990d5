"""The vertical that a robot on the ground knows, and the density of turns about it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.vertical import Vertical


def orientations(count: int, tilt_deg: float, seed: int, mounted: Rotation | None = None) -> Rotation:
    """World_from_body of a robot that turns and tilts, its body's axes mounted anyhow."""
    rng = np.random.default_rng(seed)
    heading = Rotation.from_rotvec(np.outer(rng.uniform(-np.pi, np.pi, count), [0, 0, 1]))
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * rng.normal(size=(count, 3)) * [1, 1, 0])
    return heading * tilt * (Rotation.identity() if mounted is None else mounted)


def of(world_from_body: Rotation) -> Vertical | None:
    return Vertical.of(torch.from_numpy(world_from_body.inv().as_quat()))


@pytest.mark.parametrize("seed", range(3))
def test_it_is_known_whatever_the_axes_of_world_and_body(seed: int) -> None:
    world, mounted = (Rotation.random(random_state=np.random.default_rng((seed, which))) for which in range(2))
    vertical = of(world * orientations(2000, 5.0, seed, mounted))
    assert vertical is not None
    assert abs(vertical.axis @ world.apply([0, 0, 1])) > np.cos(np.radians(0.5))
    assert np.degrees(np.sqrt(vertical.variance)) == pytest.approx(5.0, rel=0.1)


def test_nobody_knows_one_who_tumbles_or_never_turns() -> None:
    assert of(Rotation.random(500, random_state=np.random.default_rng(0))) is None
    assert of(Rotation.from_rotvec(np.outer(np.linspace(0, 0.3, 100), [0, 0, 1]))) is None


def test_turns_about_the_vertical_integrate_to_one() -> None:
    """By the uniform density over rotation vectors, drawn at random: the mean ratio is one."""
    vertical = Vertical(np.array([0.0, 0.6, 0.8]), np.radians(10.0) ** 2)
    turns = Rotation.random(200_000, random_state=np.random.default_rng(1)).as_rotvec()
    ratio = vertical.density_ratio(turns, np.zeros(len(turns)))
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
    # About it any angle is as likely, but for what all rotations of that angle share out.
    angles = np.array([0.5, 2.0, 3.0])
    about = vertical.density_ratio(angles[:, None] * vertical.axis, np.zeros(3))
    np.testing.assert_allclose(about, about[0])
    assert about[0] > 10
    assert np.isfinite(log_uniform_density(angles, 3)).all()


def test_what_is_predicted_less_well_may_swing_farther() -> None:
    vertical = Vertical(np.array([0.0, 0.0, 1.0]), np.radians(2.0) ** 2)
    turn = Rotation.from_rotvec([[np.radians(20.0), 0, 0]]) * Rotation.from_rotvec([[0, 0, 1.0]])
    exact, vague = (vertical.density_ratio(turn.as_rotvec(), np.array([p]))[0] for p in (0.0, np.radians(15.0) ** 2))
    assert exact < 1e-6 < 1 < vague


def test_an_axis_that_odometry_errs_about_most_is_the_vertical_if_it_is_near() -> None:
    """Of three axes, errs about one of them by ten times as much; the body's own is 10° off it, or 40°."""
    rng = np.random.default_rng(0)
    drift = np.array([0.0, np.sin(np.radians(10.0)), np.cos(np.radians(10.0))])
    about = rng.normal(size=(200, 1)) * drift
    residual, variance = about + 0.1 * rng.normal(size=(200, 3)), np.ones(200)
    kept = Vertical(np.array([0.0, 0.0, 1.0]), 0.01)
    assert abs(kept.sharpened(residual, variance) @ drift) > 0.999
    far = Vertical(np.array([0.0, -np.sin(np.radians(30.0)), np.cos(np.radians(30.0))]), 0.01)
    assert (far.sharpened(residual, variance) == far.axis).all()
    alike = rng.normal(size=(200, 3))
    assert (kept.sharpened(alike, variance) == kept.axis).all()
    assert (kept.sharpened(np.zeros((0, 3)), np.zeros(0)) == kept.axis).all()
