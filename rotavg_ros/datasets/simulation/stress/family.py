"""A wide family of robots' runs in which the noise of odometry and closures varies: the training data of FineNet.

It has the conditions of the stress suite, but combined, with random strength, and in more worlds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph, per_axis, simulated
from rotavg_ros.datasets.simulation.trajectories import PLANAR_WORLDS
from rotavg_ros.datasets.worlds import World
from rotavg_ros.errors import UserError

_LEAST = 1e-12
# Fields with the probabilities of all causes of uneven noise, and of none.
_CAUSES = ("even", "uneven", "level", "single", "turns", "speed", "qualities", "heavy", "common")
# Bounds of the fields; 0 and 1 for all that are not named.
_BOUNDS: dict[str, tuple[float, float]] = {
    "odometry_deg": (1e-3, 20.0),
    "closure_deg": (1e-2, 30.0),
    "closures_per_keyframe": (1e-3, 3.0),
    "false_share": (0.0, 0.9),
    "uneven_factor": (1.0, 100.0),
    "uneven_steps": (2.0, 1000.0),
    "level_spread": (0.0, 3.0),
    "quality_factor": (1.0, 100.0),
}


class RobotFamilyError(UserError):
    """An invalid family of runs; the message names the key and its range."""


@dataclass(frozen=True)
class RobotFamily:
    """The distribution that runs are drawn from; pairs are the ends of ranges.

    Attributes:
        worlds: names of worlds, all equally likely.
        planar_share: share of planar runs in worlds that may be flat; all their rotations are yaw.
        odometry_deg: root mean square angle of a usual step's error, uniform in the logarithm.
        closure_deg: the same for a usual closure.
        closures_per_keyframe: uniform in the logarithm.
        false_share: of the closures.
        grouped_share: probability that those of a run are false in groups that agree.
        even: probability that none of the following effects occurs, except false closures and stated precisions;
            otherwise, …
        uneven: probability that stretches of odometry have larger errors, …
        uneven_factor: … by this factor, …
        uneven_steps: … over this number of steps, with three to nine times as many between, …
        level: probability that odometry's noise changes slowly by a drawn level, …
        level_spread: … whose logarithm has this standard deviation.
        single: probability that single steps have levels of their own, of the same spread.
        turns: probability that odometry errs more where it turns, …
        per_turn: … by this share of the angle.
        speed: probability that speed varies and odometry errs with it.
        qualities: probability that closures are of two qualities, …
        quality_factor: … with this ratio of their errors.
        heavy: probability that closures have levels of their own, with the spread of odometry's.
        common: probability that closures of a run have common errors.
        common_share: share of their variance that they then have in common.
        stated: probability that closures state their own level; otherwise all state the same.
    """

    worlds: tuple[str, ...] = tuple(world.value for world in World)
    planar_share: float = 0.5
    odometry_deg: tuple[float, float] = (0.05, 1.5)
    closure_deg: tuple[float, float] = (0.2, 4.0)
    closures_per_keyframe: tuple[float, float] = (0.06, 1.0)
    false_share: tuple[float, float] = (0.0, 0.4)
    grouped_share: float = 0.2
    even: float = 0.0
    uneven: float = 0.4
    uneven_factor: tuple[float, float] = (2.0, 20.0)
    uneven_steps: tuple[float, float] = (8.0, 100.0)
    level: float = 0.2
    level_spread: tuple[float, float] = (0.3, 1.2)
    single: float = 0.2
    turns: float = 0.3
    per_turn: tuple[float, float] = (0.01, 0.15)
    speed: float = 0.15
    qualities: float = 0.35
    quality_factor: tuple[float, float] = (2.0, 8.0)
    heavy: float = 0.2
    common: float = 0.15
    common_share: tuple[float, float] = (0.3, 0.9)
    stated: float = 0.2

    def __post_init__(self) -> None:
        known = {world.value for world in World}
        if not self.worlds or not known.issuperset(self.worlds):
            raise RobotFamilyError(f"worlds is {list(self.worlds)}; choose some of {', '.join(sorted(known))}")
        for field in fields(self):
            if field.name == "worlds":
                continue
            value = getattr(self, field.name)
            low, high = value if isinstance(value, tuple) else (value, value)
            least, most = _BOUNDS.get(field.name, (0.0, 1.0))
            if not least <= low <= high <= most:
                what = "an ascending pair" if isinstance(value, tuple) else "a number"
                raise RobotFamilyError(f"{field.name} is {value}; use {what} between {least:g} and {most:g}")

    @classmethod
    def of(cls, content: Any) -> RobotFamily:
        """From plain values, as in a YAML file; missing keys get their defaults.

        Raises:
            RobotFamilyError: an unknown key, or a value of the wrong type or beyond its range.
        """
        if not isinstance(content, Mapping):
            raise RobotFamilyError(f"expected `key: value` lines, found {type(content).__name__}")
        usual, values = cls(), dict[str, Any]()
        for key, value in content.items():
            if not hasattr(usual, str(key)) or key not in {field.name for field in fields(cls)}:
                raise RobotFamilyError(f"unknown key {key!r}; known are {', '.join(f.name for f in fields(cls))}")
            default = getattr(usual, key)
            try:
                if key == "worlds":
                    values[key] = tuple(str(world) for world in _list(value))
                elif isinstance(default, tuple):
                    low, high = _list(value)
                    values[key] = _number(low), _number(high)
                else:
                    values[key] = _number(value)
            except (TypeError, ValueError, OverflowError):
                raise RobotFamilyError(f"{key} is {value!r}, expected like {default!r}") from None
        return cls(**values)

    def drawn(self, keyframes: int, rng: np.random.Generator) -> DrawnGraph:
        """One run of ``keyframes`` keyframes."""
        if rng.random() < self.even:
            return RobotFamily.of({**asdict(self), **dict.fromkeys(_CAUSES, 0.0)}).drawn(keyframes, rng)
        closure_deg = _log_uniform(self.closure_deg, rng)
        config = self._config(keyframes, rng)
        if rng.random() < self.common:
            config = replace(
                config, closure_noise_deg=closure_deg, closure_common_share=rng.uniform(*self.common_share)
            )
        exact = simulated(config, rng)
        exact, speed = self._with_speed(exact, rng)
        odometry, closure = ~exact.is_closure, exact.is_closure
        usual = per_axis(_log_uniform(self.odometry_deg, rng), exact.planar)
        sigma: FloatArray = usual * speed * self._levels(int(odometry.sum()), rng)
        if rng.random() < self.turns:
            turn = np.asarray(exact.true_target_from_source[np.flatnonzero(odometry)].magnitude())
            share = _log_uniform(self.per_turn, rng) / np.sqrt(1 if exact.planar else 3)
            sigma = np.hypot(sigma, share * turn)
        drawn = exact.gaussian(odometry, sigma, rng, usual)
        usual = per_axis(closure_deg, exact.planar)
        sigma = usual * self._qualities(int(closure.sum()), rng)
        on_top = np.sqrt(np.maximum(sigma**2 - exact.sigma[closure] ** 2, 0.0))
        drawn = drawn.gaussian(closure, on_top, rng, usual)
        if rng.random() < self.stated:
            precision = drawn.graph.precision.numpy().copy()
            precision[closure] = np.maximum(sigma, _LEAST) ** -2.0
            drawn = drawn.stating(precision)
        return drawn

    def _config(self, keyframes: int, rng: np.random.Generator) -> SlamSimulationConfig:
        world = World(rng.choice(self.worlds))
        planar = world in PLANAR_WORLDS and rng.random() < self.planar_share
        return SlamSimulationConfig(
            world=world,
            dimensions=2 if planar else 3,
            num_keyframes=keyframes,
            laps=rng.uniform(2, 8),
            terrain_tilt_deg=_log_uniform((1.0, 15.0), rng) if world in PLANAR_WORLDS and not planar else 0.0,
            sway_deg=0.0 if planar else rng.uniform(0, 5),
            closures_per_keyframe=_log_uniform(self.closures_per_keyframe, rng),
            false_share=rng.uniform(*self.false_share),
            grouped_share=float(rng.random() < self.grouped_share),
            odometry_noise_deg=0.0,
            closure_noise_deg=0.0,
        )

    def _with_speed(self, drawn: DrawnGraph, rng: np.random.Generator) -> tuple[DrawnGraph, FloatArray]:
        """Odometry with steps of varying length, if drawn, and ``(M,)`` the resulting factors on its errors."""
        count = int((~drawn.is_closure).sum())
        if rng.random() >= self.speed:
            return drawn, np.ones(count)
        fast = _smooth(rng.normal(size=count), rng.uniform(3, 60)) * rng.uniform(0.3, 1.0)
        translation = drawn.edge_translation.copy()
        translation[~drawn.is_closure] *= np.exp(fast)[:, None]
        graph = replace(drawn.graph, translation=torch.from_numpy(translation))
        return replace(drawn, graph=graph, edge_translation=translation), np.exp(rng.uniform(0.5, 1.5) * fast)

    def _levels(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count,)`` factors on the errors of the steps relative to a usual one, apart from turns and speed."""
        level = np.zeros(count)
        if rng.random() < self.uneven:
            steps = int(np.clip(_log_uniform(self.uneven_steps, rng), 2, max(2, count // 3)))
            every, factor = steps * _log_uniform((4.0, 10.0), rng), _log_uniform(self.uneven_factor, rng)
            for start in rng.integers(0, max(1, count - steps), max(1, round(count / every))):
                level[start : start + steps] = np.log(factor)
        if rng.random() < self.level:
            level += _smooth(rng.normal(size=count), _log_uniform((5.0, 150.0), rng)) * rng.uniform(*self.level_spread)
        if rng.random() < self.single:
            level += rng.normal(size=count) * rng.uniform(*self.level_spread)
        return np.exp(level)

    def _qualities(self, count: int, rng: np.random.Generator) -> FloatArray:
        """``(count,)`` factors on the errors of the closures relative to a usual one."""
        level = np.zeros(count)
        if rng.random() < self.qualities:
            share, stay = rng.uniform(0.15, 0.85), rng.choice([0.0, 0.0, 0.8, 0.95])
            is_worse = rng.random(count) < share
            last = np.maximum.accumulate(np.where(rng.random(count) >= stay, np.arange(count), 0))
            level += is_worse[last] * np.log(_log_uniform(self.quality_factor, rng))
        if rng.random() < self.heavy:
            level += rng.normal(size=count) * rng.uniform(*self.level_spread)
        return np.exp(level)


def _list(value: Any) -> list[Any] | tuple[Any, ...]:
    """The list; a text and a mapping can be gone through as well, but are none."""
    if not isinstance(value, list | tuple):
        raise TypeError(value)
    return value


def _number(value: Any) -> float:
    """The number; ``float`` would take ``true`` for 1."""
    if isinstance(value, bool):
        raise TypeError(value)
    return float(value)


def _smooth(values: FloatArray, steps: float) -> FloatArray:
    """White noise smoothed over ``steps`` steps and scaled back to a standard deviation of one."""
    smooth = gaussian_filter1d(values, steps)
    return np.asarray((smooth - smooth.mean()) / max(float(smooth.std()), _LEAST))


def _log_uniform(ends: tuple[float, float], rng: np.random.Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(np.maximum(ends, _LEAST)))))
