"""Parameters of a simulated SLAM run: :class:`SlamSimulationConfig`, and the wide family that training draws from."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import Enum

import numpy as np

from rotavg_ros.datasets.simulation.trajectories import PLANAR_WORLDS, World
from rotavg_ros.errors import UserError


class SlamSimulationError(UserError):
    """An impossible simulation was requested; the message names the field."""


class Precisions(str, Enum):
    """What the simulated front end states about the precision of its edges."""

    MISSING = "missing"
    RIGHT = "right"
    SCALED = "scaled"  # right up to one factor for odometry and one for loop closures
    UNIT = "unit"  # 1 rad⁻² everywhere, as exporters write when they do not know


@dataclass(frozen=True)
class SlamSimulationConfig:
    """One simulated run. Noise is isotropic in 3D and about the vertical in 2D.

    Attributes:
        world: where the robot drives.
        dimensions: 2 (all rotations are yaw) or 3.
        num_keyframes: poses along the trajectory.
        laps: about how often every place is visited.
        keyframe_distance_m, keyframe_period_s: spacing of the keyframes.
        turn_radius_m: scale on which corners are rounded.
        terrain_tilt_deg: typical slope of the ground (3D ground worlds).
        sway_deg: smooth shaking of the body on top of the path.
        odometry_noise_deg: root mean square angle of one step's random error.
        odometry_bias_deg: systematic error of every step, a fixed rotation of the body (gyroscope bias).
        odometry_translation_noise: error of a step's translation over its length.
        odometry_backward: odometry edges run keyframe → previous.
        slip_share: share of the odometry edges that are off by 20–60°.
        closures_per_keyframe: loop closures over keyframes (fewer where too few places are seen again).
        closure_radius_m: a closure's ends are at most this far apart.
        min_closure_gap: and at least this many keyframes apart in time …
        short_range_share: … except for this share, which connects keyframes 2–8 steps apart.
        closure_noise_deg: root mean square angle of a good closure's error.
        closure_common_share: share of that error's variance that closures between the same two stretches of the path
            have in common (the same view, the same bias), as in real front ends.
        closure_translation_noise_m: standard deviation per axis.
        backward_share: share of the closures that run new → old.
        noise_spread: standard deviation of the logarithm of the noise level from edge to edge.
        false_share: share of the closures made false …
        grouped_share: … of them in runs of 4–12 that share one wrong world-frame rotation (perceptual aliasing) …
        near_miss_share: … and of them off by 10–30° only; the rest is random.
        in_place_share: share of the false closures whose ends are truly near each other; the rest connects places
            that only look alike.
        precisions: what the edges state.
        odometry_precision_factor, closure_precision_factor: stated over true precision, for ``Precisions.SCALED``.
    """

    world: World = World.BUILDING
    dimensions: int = 2
    num_keyframes: int = 1000
    laps: float = 4.0
    keyframe_distance_m: float = 0.5
    keyframe_period_s: float = 0.5
    turn_radius_m: float = 1.0
    terrain_tilt_deg: float = 0.0
    sway_deg: float = 0.0
    odometry_noise_deg: float = 0.5
    odometry_bias_deg: float = 0.0
    odometry_translation_noise: float = 0.02
    odometry_backward: bool = False
    slip_share: float = 0.0
    closures_per_keyframe: float = 0.2
    closure_radius_m: float = 1.5
    min_closure_gap: int = 20
    short_range_share: float = 0.0
    closure_noise_deg: float = 1.0
    closure_common_share: float = 0.0
    closure_translation_noise_m: float = 0.05
    backward_share: float = 0.5
    noise_spread: float = 0.0
    false_share: float = 0.3
    grouped_share: float = 0.0
    near_miss_share: float = 0.0
    in_place_share: float = 0.5
    precisions: Precisions = Precisions.RIGHT
    odometry_precision_factor: float = 1.0
    closure_precision_factor: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not 0 <= value < float("inf"):
                raise SlamSimulationError(f"{field.name} is {value}; it must be finite and must not be negative")
        if self.dimensions not in (2, 3):
            raise SlamSimulationError(f"dimensions is {self.dimensions}; use 2 or 3")
        if self.dimensions == 2 and self.world not in PLANAR_WORLDS:
            raise SlamSimulationError(f"the world '{self.world.value}' is not flat; use dimensions=3")
        if self.dimensions == 2 and self.terrain_tilt_deg > 0:
            raise SlamSimulationError("terrain_tilt_deg needs dimensions=3")
        if self.num_keyframes < 10:
            raise SlamSimulationError(f"num_keyframes is {self.num_keyframes}; use at least 10")
        for name in (
            "slip_share",
            "short_range_share",
            "backward_share",
            "false_share",
            "in_place_share",
            "closure_common_share",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise SlamSimulationError(f"{name} is {getattr(self, name)}; a share lies in [0, 1]")
        if self.grouped_share + self.near_miss_share > 1 + 1e-12:
            raise SlamSimulationError("grouped_share and near_miss_share are parts of the false closures: at most 1")
        for name in ("laps", "keyframe_distance_m", "keyframe_period_s", "closure_radius_m"):
            if getattr(self, name) <= 0:
                raise SlamSimulationError(f"{name} is {getattr(self, name)}; it must be positive")


def random_slam_config(rng: np.random.Generator, num_keyframes: int | None = None) -> SlamSimulationConfig:
    """Draw a run from the wide family: every world, odometry and front end from excellent to terrible.

    Args:
        rng: source of every random choice.
        num_keyframes: default: between 100 and 10 000, uniform in the logarithm.
    """
    if num_keyframes is None:
        num_keyframes = round(_log_uniform(rng, 100, 10_000))
    world = World(rng.choice([world.value for world in World]))
    dimensions = int(rng.integers(2, 4)) if world in PLANAR_WORLDS else 3
    tilt_deg = sway_deg = 0.0
    if dimensions == 3:
        # From nearly planar to hilly; some carriers shake.
        tilt_deg = _log_uniform(rng, 0.3, 20) if world in PLANAR_WORLDS else 0.0
        sway_deg = _log_uniform(rng, 0.3, 15) if rng.random() < 0.5 else 0.0
    odometry_noise_deg = _log_uniform(rng, 0.01, 5)
    step_m = _log_uniform(rng, 0.1, 2)
    grouped, near_miss, _ = rng.dirichlet([0.5, 0.3, 0.7])
    return SlamSimulationConfig(
        world=world,
        dimensions=dimensions,
        num_keyframes=num_keyframes,
        laps=rng.uniform(1.5, 10),
        keyframe_distance_m=step_m,
        keyframe_period_s=step_m / rng.uniform(0.3, 5),
        turn_radius_m=step_m * rng.uniform(0.3, 4),
        terrain_tilt_deg=tilt_deg,
        sway_deg=sway_deg,
        odometry_noise_deg=odometry_noise_deg,
        odometry_bias_deg=odometry_noise_deg * rng.uniform(0, 0.3) if rng.random() < 0.4 else 0.0,
        odometry_translation_noise=_log_uniform(rng, 0.002, 0.1),
        odometry_backward=bool(rng.random() < 0.2),
        slip_share=_log_uniform(rng, 0.001, 0.03) if rng.random() < 0.3 else 0.0,
        closures_per_keyframe=_log_uniform(rng, 0.005, 2.5),
        closure_radius_m=step_m * rng.uniform(1.5, 4),
        min_closure_gap=int(rng.integers(5, 30)),
        short_range_share=rng.uniform(0, 0.8) if rng.random() < 0.3 else 0.0,
        closure_noise_deg=_log_uniform(rng, 0.1, 10),
        closure_common_share=rng.uniform(0.2, 0.9) if rng.random() < 0.5 else 0.0,
        closure_translation_noise_m=step_m * rng.uniform(0.02, 0.5),
        backward_share=float(rng.choice([0.0, 0.5, 1.0])),
        noise_spread=rng.uniform(0.1, 0.7) if rng.random() < 0.4 else 0.0,
        false_share=rng.uniform(0, 0.8) if rng.random() < 0.9 else 0.0,
        grouped_share=grouped,
        near_miss_share=near_miss,
        in_place_share=float(rng.choice([0.0, 0.5, 1.0])),
        precisions=Precisions(rng.choice([precisions.value for precisions in Precisions])),
        odometry_precision_factor=_log_uniform(rng, 0.01, 100),
        closure_precision_factor=_log_uniform(rng, 0.01, 100),
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
