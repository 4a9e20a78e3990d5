"""Noise and front ends that robots have in every world: each condition is drawn in the plane and in space."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.stress import closure_errors, odometry_errors
from rotavg_ros.datasets.simulation.stress.drawn import Change, DrawnGraph, simulated
from rotavg_ros.datasets.worlds import World

# Defaults: half a degree a step and one degree a closure, and a fifth of the closures false and random.
_USUAL = SlamSimulationConfig(
    num_keyframes=500, closures_per_keyframe=0.4, odometry_noise_deg=0.5, closure_noise_deg=1.0, false_share=0.2
)
WORLDS = {
    "building": _USUAL,
    "hills": replace(_USUAL, dimensions=3, terrain_tilt_deg=10.0, sway_deg=3.0),
    "sphere": replace(_USUAL, world=World.SPHERE, dimensions=3, num_keyframes=600),
    "grid": replace(_USUAL, world=World.GRID, num_keyframes=600, laps=6.0),
}
SPATIAL = ("hills", "sphere")


@dataclass(frozen=True)
class Condition:
    """Differences from the usual run.

    Attributes:
        name: of the condition.
        config: fields of the simulation that differ.
        change: a change to the simulated run.
        worlds: the worlds in which it is drawn.
    """

    name: str
    config: dict[str, Any] = field(default_factory=dict)
    change: Change | None = None
    worlds: tuple[str, ...] = tuple(WORLDS)

    def drawn(self, world: str, rng: np.random.Generator) -> DrawnGraph:
        """One drawing."""
        graph = simulated(replace(WORLDS[world], **self.config), rng)
        return graph if self.change is None else self.change(graph, rng)


_NO_STEP_NOISE = {"odometry_noise_deg": 0.0}
_NO_CLOSURE_NOISE = {"closure_noise_deg": 0.0}
_THIRD = {"false_share": 0.3}

CONDITIONS = (
    Condition("30 % random", _THIRD),
    Condition("50 % random", {"false_share": 0.5}),
    Condition("80 % random", {"false_share": 0.8}),
    Condition("30 % grouped", {**_THIRD, "grouped_share": 1.0}),
    Condition("30 % near misses", {**_THIRD, "near_miss_share": 1.0}),
    Condition("30 % near misses in groups", {"false_share": 0.0}, partial(closure_errors.near_misses_in_groups, 0.3)),
    Condition("closures of two qualities", _NO_CLOSURE_NOISE, closure_errors.two_qualities),
    Condition("heavy-tailed closures", _NO_CLOSURE_NOISE, closure_errors.heavy_tailed),
    Condition("closures with common errors", {"closure_common_share": 0.7, "closure_noise_deg": 2.0}),
    Condition("closures of 6°", {"closure_noise_deg": 6.0}),
    Condition("odometry worse in turns", _NO_STEP_NOISE, odometry_errors.worse_in_turns),
    Condition("uneven odometry", _NO_STEP_NOISE, odometry_errors.uneven),
    Condition("Student odometry", _NO_STEP_NOISE, odometry_errors.student),
    Condition("gyroscope bias, 30 % random", {**_THIRD, "odometry_noise_deg": 0.1, "odometry_bias_deg": 0.2}),
    Condition("drift in yaw alone", _NO_STEP_NOISE, odometry_errors.yaw_alone, SPATIAL[:1]),
    Condition("4° steps, 50 % random", {"odometry_noise_deg": 4.0, "false_share": 0.5}),
    Condition("half of the edges twice", {}, partial(closure_errors.repeated, 0.5, 2), ("building", "sphere")),
    Condition("a fifth of the edges five times", {}, partial(closure_errors.repeated, 0.2, 5), ("hills", "grid")),
    Condition("precisions spread", {}, closure_errors.spread_precisions),
    Condition("precisions off by factors", {}, closure_errors.precisions_by_factors, ("building", "sphere")),
    Condition("odometry without precision", {}, closure_errors.odometry_without_precision, ("hills", "grid")),
    Condition("15 closures", {}, partial(closure_errors.few, 12, 3)),
)
