"""Errors of odometry that do not occur in the wide family of simulated runs: each is added to exact odometry.

Every front end here states one precision for all its steps, that of its usual step.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph, per_axis

# Root mean square angle of a usual step's error.
_STEP_DEG = 0.2
# Further error per angle that a step turns by.
_PER_TURN = 0.05
_UNEVEN_FACTOR = 10
_UNEVEN_STEPS = 30
# Number of steps per stretch of uneven ones.
_UNEVEN_EVERY = 200
# Steps over which slowly changing noise keeps its level, and the standard deviation of its logarithm.
_LEVEL_STEPS, _LEVEL_SPREAD = 150, 1.0


def worse_in_turns(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """An error of 0.2° a step, and 5 % of the angle that the step turns by."""
    steps = ~drawn.is_closure
    turn_deg = np.degrees(drawn.true_target_from_source[np.flatnonzero(steps)].magnitude())
    usual = per_axis(_STEP_DEG, drawn.planar)
    sigma = np.array([per_axis(angle, drawn.planar) for angle in np.hypot(_STEP_DEG, _PER_TURN * turn_deg)])
    return drawn.gaussian(steps, sigma, rng, usual)


def uneven(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """An error of 0.2° a step, and ten times that for thirty steps in a row, once in about 200 steps."""
    steps = ~drawn.is_closure
    usual = per_axis(_STEP_DEG, drawn.planar)
    count = int(steps.sum())
    sigma = np.full(count, usual)
    for start in rng.integers(0, count - _UNEVEN_STEPS, max(1, count // _UNEVEN_EVERY)):
        sigma[start : start + _UNEVEN_STEPS] = _UNEVEN_FACTOR * usual
    return drawn.gaussian(steps, sigma, rng, usual)


def student(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """Student's t with three degrees of freedom and a scale of 0.2° a step."""
    return drawn.student(~drawn.is_closure, _STEP_DEG, rng)


def yaw_alone(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """An error of 1° a step about the true vertical only, as where gravity fixes roll and pitch."""
    steps = ~drawn.is_closure
    up = Rotation.from_quat(drawn.body_from_world[drawn.graph.target.numpy()[steps]]).apply([0.0, 0.0, 1.0])
    vectors = up * np.radians(rng.normal(size=(len(up), 1)))
    usual = per_axis(1.0, drawn.planar)
    return drawn.with_noise(steps, vectors, np.full(len(up), usual), usual)


def changing_level(drawn: DrawnGraph, rng: np.random.Generator) -> DrawnGraph:
    """An error of a tenth of a degree a step, whose level changes slowly by factors of about three either way."""
    steps = ~drawn.is_closure
    usual = per_axis(0.1, drawn.planar)
    level = gaussian_filter1d(rng.normal(size=int(steps.sum())), _LEVEL_STEPS)
    sigma = usual * np.exp(_LEVEL_SPREAD * level / max(float(level.std()), 1e-12))
    return drawn.gaussian(steps, sigma, rng, usual)
