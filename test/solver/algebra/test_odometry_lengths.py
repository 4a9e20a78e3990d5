"""How long a typical step of odometry is."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros import ViewGraph, solve
from rotavg_ros.solver.algebra.odometry_lengths import typical_length


def typical(length: np.ndarray) -> float:
    return typical_length(length, np.ones(len(length)), np.ones(len(length), dtype=bool))


@pytest.mark.parametrize("standing", [0, 100, 5000])
@pytest.mark.parametrize("jump", [0.5, 1e6])
def test_neither_standing_still_nor_jumps_change_it(standing: int, jump: float) -> None:
    rng = np.random.default_rng(0)
    moving = rng.uniform(0.4, 0.6, 1000)
    length = np.concatenate((moving, rng.exponential(5e-4, standing), np.full(3, jump)))
    assert typical(rng.permutation(length)) == pytest.approx(np.median(moving), rel=0.01)
    assert typical(1000 * length) == pytest.approx(1000 * typical(length))


@pytest.mark.parametrize("steps", [3, 60, 98])
def test_one_jump_in_a_short_run_does_not_change_it(steps: int) -> None:
    assert typical(np.append(np.ones(steps), 1e6)) == 1.0


def test_where_few_or_no_steps_move() -> None:
    assert typical(np.zeros(5)) == typical(np.zeros(0)) == 1.0
    assert typical(np.array([0.0, 0.0, 0.3])) == 0.3
    # All but one of many: a jump, or all that a robot has moved.
    assert typical(np.append(np.zeros(500), 7.0)) == 7.0


def standing_robot(noise_m: float) -> tuple[ViewGraph, np.ndarray]:
    """Three laps of a square, with a stop of sixty keyframes on each side, whose shifts are sensors' noise."""
    rng = np.random.default_rng(0)
    corners = np.repeat(np.arange(12), 15)
    moving = np.ones(len(corners), dtype=bool)
    stops = np.arange(7, len(corners), 15)
    heading = np.pi / 2 * np.insert(corners, np.repeat(stops, 60), corners[np.repeat(stops, 60)])
    moving = np.insert(moving, np.repeat(stops, 60), False)
    step = np.stack((np.cos(heading), np.sin(heading)), axis=1) * moving[:, None]
    position = np.concatenate((np.zeros((1, 2)), np.cumsum(step, axis=0)[:-1]))
    edges = []

    def add(i: int, j: int, sigma: tuple[float, float], kind: int) -> None:
        turn = heading[j] - heading[i] + rng.normal(0, sigma[0])
        c, s = np.cos(heading[i]), np.sin(heading[i])
        shift = np.array([[c, s], [-s, c]]) @ (position[j] - position[i]) + rng.normal(0, sigma[1], 2)
        edges.append((i, j, [0, 0, np.sin(turn / 2), np.cos(turn / 2)], [*shift, 0], kind))

    for i in range(len(heading) - 1):
        add(i, i + 1, (np.radians(0.3), 0.03) if moving[i] else (np.radians(0.01), noise_m), 0)
    lap = len(heading) // 3
    for i in rng.choice(2 * lap, 40, replace=False):
        add(i, i + lap, (np.radians(0.8), 0.05), 1)
    source, target, rotation, translation, kind = zip(*edges, strict=True)
    graph = ViewGraph.create(source, target, source_from_target=rotation, translation=translation, kind=kind)
    return graph, np.c_[position, np.zeros(len(position))]


def test_noise_of_a_robot_that_stands_still_does_not_tell_how_far_it_goes() -> None:
    """Positions are as accurate, and stated to be, as where it stands exactly."""
    (exact, position), (noisy, _) = standing_robot(0.0), standing_robot(3e-4)
    found = solve(exact), solve(noisy)
    rms = [float(np.sqrt(((each.position.numpy() - position) ** 2).sum(axis=1).mean())) for each in found]
    stated = [float(each.position_uncertainty.numpy().mean()) for each in found]
    assert rms[1] == pytest.approx(rms[0], rel=0.05)
    assert stated[1] == pytest.approx(stated[0], rel=0.05)
