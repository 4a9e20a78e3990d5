"""The named list: every condition in every world, and robots' runs on which solvers are known to fail."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.stress import closure_errors, odometry_errors, robots, slips
from rotavg_ros.datasets.simulation.stress.conditions import CONDITIONS, WORLDS
from rotavg_ros.datasets.simulation.stress.drawn import Change, DrawnGraph, per_axis, simulated
from rotavg_ros.datasets.worlds import World

# Keeps these random numbers separate from all others.
_STREAM = 0x57E55
# Only the first seeds are used for tuning; the second are reported.
TUNING_SEEDS = range(20)
REPORTING_SEEDS = range(1000, 1020)


@dataclass(frozen=True)
class StressKind:
    """A kind of graphs.

    Attributes:
        world: the world or family, before the colon of its name.
        condition: the condition, after the colon.
        draw: function from a random generator to a graph.
    """

    world: str
    condition: str
    draw: Callable[[np.random.Generator], DrawnGraph]

    @property
    def name(self) -> str:
        return f"{self.world}: {self.condition}"

    def drawn(self, seed: int) -> DrawnGraph:
        """The graph of a seed, the same in every call."""
        return self.draw(np.random.default_rng((seed, _STREAM, zlib.crc32(self.name.encode()))))


def _changed(config: SlamSimulationConfig, change: Change, rng: np.random.Generator) -> DrawnGraph:
    return change(simulated(config, rng), rng)


def _conditions() -> Iterator[StressKind]:
    for world in WORLDS:
        for condition in CONDITIONS:
            if world in condition.worlds:
                yield StressKind(world, condition.name, partial(condition.drawn, world))


# A drive through streets with 26 closures, 16 of them false in groups that agree.
_DRIVE = SlamSimulationConfig(
    world=World.CITY,
    num_keyframes=700,
    laps=6.0,
    odometry_noise_deg=0.35,
    closure_noise_deg=0.0,
    closures_per_keyframe=26 / 700,
    false_share=16 / 26,
    grouped_share=1.0,
)
_DRIVE_CLOSURE_DEG = 1.0
# Streets that meet at right angles.
_CITY = SlamSimulationConfig(
    world=World.CITY,
    num_keyframes=800,
    laps=6.0,
    turn_radius_m=0.05,
    odometry_noise_deg=0.1,
    closures_per_keyframe=0.25,
    false_share=0.3,
)
_CITY_SLIP_SHARE = 0.01
_HALF_FALSE = replace(WORLDS["building"], closure_noise_deg=1.15, false_share=0.5, closures_per_keyframe=0.5)
_ROBOT_KEYFRAMES = {2: 600, 3: 750, 8: 800}
_CLEAN_TRACK = SlamSimulationConfig(
    world=World.LAPS, num_keyframes=400, laps=4.0, odometry_noise_deg=0.2, closures_per_keyframe=0.3, false_share=0.0
)
_WITNESSES = (3, 5, 10, 20)
# Part of the names of kinds whose slip cannot be told from a false group.
ONE_PAIR = "one pair of places"


def _drive(all_noisy: bool, rng: np.random.Generator) -> DrawnGraph:
    """False closures agree exactly, or up to the noise of the good ones."""
    drawn = simulated(_DRIVE, rng)
    noisy = drawn.is_closure & (all_noisy | ~drawn.is_wrong)
    sigma = per_axis(_DRIVE_CLOSURE_DEG, drawn.planar)
    precision = np.where(drawn.is_closure, sigma**-2, drawn.graph.precision.numpy())
    return drawn.stating(precision).gaussian(noisy, np.full(int(noisy.sum()), sigma), rng, sigma)


def _city(grouped: bool, exact: bool, rng: np.random.Generator) -> DrawnGraph:
    """Closures state one degree, whether they have noise or not."""
    config = replace(_CITY, grouped_share=float(grouped), closure_noise_deg=0.0 if exact else 1.0)
    drawn = simulated(config, rng)
    stated = np.where(drawn.is_closure, np.radians(1.0) ** -2, drawn.graph.precision.numpy())
    return slips.small_slips(_CITY_SLIP_SHARE, drawn.stating(stated), rng)


def _found_before() -> Iterator[StressKind]:
    for world in ("building", "hills"):
        config = replace(WORLDS[world], false_share=0.25)
        yield StressKind(world, "precisions that lie", partial(_changed, config, closure_errors.lying_precisions))
    yield StressKind("drive", "26 closures, 16 agree exactly", partial(_drive, False))
    yield StressKind("drive", "26 closures, 16 agree with noise", partial(_drive, True))
    for grouped in (True, False):
        for exact in (True, False):
            what = f"30 % {'grouped' if grouped else 'random'}, {'exact' if exact else 'noisy'} closures"
            yield StressKind("city", f"small slips, {what}", partial(_city, grouped, exact))
    turning = replace(_CITY, odometry_noise_deg=0.0)
    yield StressKind("city", "odometry worse in turns", partial(_changed, turning, odometry_errors.worse_in_turns))
    for count, keyframes in _ROBOT_KEYFRAMES.items():
        config = replace(_HALF_FALSE, num_keyframes=keyframes)
        yield StressKind(f"{count} robots", "half random", partial(_changed, config, partial(robots.separated, count)))
    far = replace(
        WORLDS["building"], num_keyframes=800, closures_per_keyframe=20 / 800, odometry_noise_deg=2.8, false_share=0.1
    )
    yield StressKind("building", "20 closures over a drift of 80°", partial(simulated, far))
    large = replace(
        WORLDS["building"],
        num_keyframes=15_000,
        laps=8.0,
        closures_per_keyframe=0.1,
        odometry_noise_deg=0.0,
        false_share=0.0,
    )
    level = partial(_changed, large, odometry_errors.changing_level)
    yield StressKind("building", "15 000 poses of uneven drift", level)
    for world in ("building", "hills"):
        config = replace(WORLDS[world], false_share=0.0)
        alike = partial(closure_errors.places_that_look_alike, 0.3)
        yield StressKind(world, "30 % of two places that look alike", partial(_changed, config, alike))
    quick = RobotRun(laps=2, odometry_noise_deg=0.3, closure_noise_deg=4, false_share=0.5, grouped=True).config()
    yield StressKind("robot run", "4° closures, half of them grouped", partial(simulated, quick))
    dense = replace(WORLDS["building"], closures_per_keyframe=1.0, odometry_noise_deg=0.2, false_share=0.3)
    yield StressKind("building", "locatable slips, 30 % random", partial(_changed, dense, slips.locatable_slips))


def _lone_slips() -> Iterator[StressKind]:
    """Kinds with a single slip, alternately in the plane and on hills."""
    for number, witnesses in enumerate(_WITNESSES):
        spatial = replace(_CLEAN_TRACK, dimensions=3, terrain_tilt_deg=10.0, sway_deg=3.0)
        for from_one_pair in (True, False):
            config = spatial if (number + from_one_pair) % 2 else _CLEAN_TRACK
            places = ONE_PAIR if from_one_pair else "three pairs of places"
            change = partial(slips.lone_slip, witnesses, from_one_pair)
            yield StressKind("lone slip", f"{witnesses} witnesses, {places}", partial(_changed, config, change))


KINDS: tuple[StressKind, ...] = (*_conditions(), *_found_before(), *_lone_slips())
