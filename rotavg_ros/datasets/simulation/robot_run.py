"""A robot on several laps of a building or of city streets, sampled at 10 Hz: the run for demos and first tries."""

from __future__ import annotations

from dataclasses import dataclass

from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig, SlamSimulationError
from rotavg_ros.datasets.worlds import ROBOT_WORLDS, World

SAMPLE_PERIOD_S = 0.1


@dataclass(frozen=True)
class _Surroundings:
    """What differs between driving in a building and through a city."""

    speed_mps: float
    lap_m: float
    turn_radius_m: float
    closure_radius_m: float
    tilt_deg: float


_SURROUNDINGS = {
    World.BUILDING: _Surroundings(speed_mps=0.8, lap_m=120, turn_radius_m=0.6, closure_radius_m=1.0, tilt_deg=6),
    World.CITY: _Surroundings(speed_mps=6, lap_m=900, turn_radius_m=5, closure_radius_m=5, tilt_deg=4),
}


@dataclass(frozen=True)
class RobotRun:
    """Parameters of such a run.

    Attributes:
        world: ``building`` or ``city``.
        dimensions: 2, or 3 for ramps and uneven ground.
        laps: about how often every place is visited.
        false_share: share of the loop closures that are false.
        grouped: false closures come in groups of 4–12 that agree with each other, instead of being random.
        closures_per_minute: rate of loop closures, on average.
        odometry_noise_deg: root mean square angle of the error that odometry adds every 0.1 s.
        odometry_bias_deg_per_min: systematic drift (gyroscope bias).
        closure_noise_deg: root mean square angle of a good closure's error.
    """

    world: str = "building"
    dimensions: int = 2
    laps: float = 4
    false_share: float = 0.3
    grouped: bool = False
    closures_per_minute: float = 20
    odometry_noise_deg: float = 0.1
    odometry_bias_deg_per_min: float = 2.0
    closure_noise_deg: float = 1.0

    def config(self) -> SlamSimulationConfig:
        """The configuration of its simulation; every pose is one odometry message.

        Raises:
            SlamSimulationError: a value that makes no sense; the message names it.
        """
        if self.world not in ROBOT_WORLDS:
            raise SlamSimulationError(f"unknown world '{self.world}'; choose one of {', '.join(ROBOT_WORLDS)}")
        if not 1 <= self.laps <= 100:
            raise SlamSimulationError(f"laps is {self.laps}; use 1 to 100")
        surroundings = _SURROUNDINGS[World(self.world)]
        step_m = surroundings.speed_mps * SAMPLE_PERIOD_S
        return SlamSimulationConfig(
            world=World(self.world),
            dimensions=self.dimensions,
            num_keyframes=round(self.laps * surroundings.lap_m / step_m),
            laps=self.laps,
            keyframe_distance_m=step_m,
            keyframe_period_s=SAMPLE_PERIOD_S,
            turn_radius_m=surroundings.turn_radius_m,
            terrain_tilt_deg=surroundings.tilt_deg if self.dimensions == 3 else 0.0,
            sway_deg=1.0 if self.dimensions == 3 else 0.0,
            odometry_noise_deg=self.odometry_noise_deg,
            odometry_bias_deg=self.odometry_bias_deg_per_min * SAMPLE_PERIOD_S / 60,
            closures_per_keyframe=self.closures_per_minute * SAMPLE_PERIOD_S / 60,
            closure_radius_m=surroundings.closure_radius_m,
            min_closure_gap=round(20 / SAMPLE_PERIOD_S),
            closure_noise_deg=self.closure_noise_deg,
            false_share=self.false_share,
            grouped_share=1.0 if self.grouped else 0.0,
        )
