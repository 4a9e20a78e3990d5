"""The node's parameters: one frozen dataclass from which declarations, YAML and the README's table are made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from rotavg_ros.inputs import BRINGS_KEYFRAMES, FRAMELESS_ODOMETRY, Source
from rotavg_ros.online import EstimatorOptions, quaternion
from rotavg_ros.online.odometry.time_jumps import POLICIES
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.settings.fields import ParameterError, check, parameter
from rotavg_ros.solver import DEVICES, PROFILES
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE

NODE_NAME = "rotavg"


@dataclass(frozen=True)
class NodeParameters:
    """Every parameter of the node; ``live`` ones can be changed while it runs."""

    odometry_topics: tuple[str, ...] = parameter(
        ("odom",), "topics of odometry, one per robot, 'topic' (nav_msgs/msg/Odometry) or 'topic:package/msg/Type'"
    )
    robots: tuple[str, ...] = parameter(
        ("robot",),
        "name of the robot behind each odometry topic; messages that number robots mean places in this list, counted "
        "from 0, or the numbers themselves where these are the names",
    )
    odometry_sensor_orientations: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0, 1.0),
        "orientation of each odometry topic's sensor frame in the body frame, xyzw one after the other; one for all, "
        "or one per odometry topic",
    )
    edge_topics: tuple[str, ...] = parameter(
        ("relative_rotations", "relative_rotation_arrays:rotavg_msgs/msg/RelativeRotationArray"),
        "topics of relative rotations, 'topic' (rotavg_msgs/msg/RelativeRotation) or 'topic:package/msg/Type'",
    )
    edge_robots: tuple[str, ...] = parameter(
        ("",),
        "robot that an edge topic's messages are about where they name none; one for all, or one per edge topic; "
        "empty: the first of robots",
    )
    edge_sensor_orientations: tuple[float, ...] = parameter(
        (0.0, 0.0, 0.0, 1.0),
        "orientation of each edge topic's sensor frame in the body frame, xyzw one after the other; one for all, "
        "or one per edge topic",
    )
    world_frame: str = parameter("map", "frame id of what is published")
    publish_tf: bool = parameter(
        False, "publish world → odometry frame on /tf, rotation only and no translation yet; needs tf2_msgs"
    )
    odometry_queue_depth: int = parameter(10_000, "messages that may wait per odometry topic", low=1, high=1_000_000)
    edge_queue_depth: int = parameter(10_000, "messages that may wait per edge topic", low=1, high=1_000_000)

    keyframe_source: str = parameter(
        "odometry",
        "'odometry': keyframes are chosen from odometry messages; 'edges': a front end sends them as odometry edges",
        choices=("odometry", "edges"),
    )
    unknown_keyframes: str = parameter(
        "wait", "an edge that names an unknown keyframe waits for it, or creates it", choices=("wait", "create")
    )
    keyframe_angle_deg: float = parameter(
        5.0, "turn that makes a keyframe; 0 switches the criterion off", low=0.0, high=360.0, live=True
    )
    keyframe_distance_m: float = parameter(
        0.5, "way that makes a keyframe; 0 switches the criterion off", low=0.0, high=1e6, live=True
    )
    keyframe_interval_s: float = parameter(
        0.0,
        "time that makes a keyframe; 0 switches the criterion off; with all three off every message is one",
        low=0.0,
        high=1e6,
        live=True,
    )
    stamp_tolerance_s: float = parameter(
        0.1, "how far before the first or after the last odometry an edge's stamp may be", low=0.0, high=60.0, live=True
    )
    max_odometry_gap_s: float = parameter(
        5.0, "between odometry messages farther apart no edge is placed", low=0.0, high=1e6, live=True
    )
    max_turn_rate_deg_s: float = parameter(
        360.0,
        "odometry that turns faster has jumped, and begins a new component if it goes on from there; 0: believe all, "
        "a return to zero as well",
        low=0.0,
        high=1e6,
        live=True,
    )
    max_speed_m_s: float = parameter(
        50.0, "odometry that moves faster has jumped, likewise; 0: any speed", low=0.0, high=1e6, live=True
    )
    max_stamp_lead_s: float = parameter(
        60.0,
        "a stamp farther ahead of the last needs a second message to be believed; 0: believe all",
        low=0.0,
        high=1e9,
        live=True,
    )
    on_time_jump: str = parameter(
        "new_component",
        "when the data's time goes back (a bag or a simulation that begins again, a clock that was set): keep the "
        "graph and begin a new component; forget everything and begin anew, which suits a bag in a loop; or refuse "
        "odometry until it is ahead again, silently or with an error in the diagnostics",
        choices=POLICIES,
        live=True,
    )
    time_jump_s: float = parameter(
        1.0, "going back by less is no jump; such odometry is refused as out of order", low=0.0, high=1e6, live=True
    )
    max_keyframes: int = parameter(
        200_000,
        "at so many keyframes those that can best be spared are taken out, first without any loss, then with some",
        low=1,
        high=100_000_000,
        live=True,
    )
    max_edges: int = parameter(
        2_000_000,
        "at so many edges the loop closures that can best be spared are dropped",
        low=1,
        high=1_000_000_000,
        live=True,
    )
    pending_capacity: int = parameter(
        20_000, "edges that may wait for a keyframe or for odometry; the oldest go first", low=1, high=10_000_000
    )
    pending_timeout_s: float = parameter(300.0, "how long they may wait, in the data's time", low=0.0, high=1e9)
    gauge: str = parameter(
        "odometry",
        "orientation of the first keyframe of a component: the odometry's, or identity",
        choices=("odometry", "identity"),
    )

    solve_period_s: float = parameter(
        0.5, "how often to look for something new to solve", low=0.01, high=3600.0, live=True
    )
    method: str = parameter("neurora", "solver, as in `rotavg solve --method`", live=True)
    profile: str = parameter("auto", "'slam', 'sfm', or by what the edges are", choices=tuple(PROFILES), live=True)
    device: str = parameter("auto", "where the networks run", choices=tuple(DEVICES))
    refinement_steps: int = parameter(
        -1, "refinement steps at most, 0 for none, -1 for the profile's own number", low=-1, high=1000, live=True
    )
    warm_start: bool = parameter(True, "start from the last answer while data flows", live=True)
    outlier_threshold: float = parameter(0.5, "an edge with a higher score is an outlier", low=0.0, high=1.0, live=True)
    solver_threads: int = parameter(0, "threads of a solve; 0: all cores but one", low=0, high=1024)

    state_file: str = parameter("", "file for ~/save and ~/load, read at start if it exists; empty: none")
    autosave_period_s: float = parameter(0.0, "save the state this often if it changed; 0: never", low=0.0, high=1e6)
    odometry_timeout_s: float = parameter(
        5.0, "diagnostics warn when no odometry has come for longer", low=0.1, high=1e6, live=True
    )

    def __post_init__(self) -> None:
        for each in fields(self):
            check(each, getattr(self, each.name))
        self._check_topics()
        if self.autosave_period_s > 0 and not self.state_file:
            raise ParameterError("autosave_period_s is set but state_file is empty; name a file")
        self._check_frames()
        self.estimator_options()

    def _check_topics(self) -> None:
        for name in ("odometry_topics", "robots", "edge_topics"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                raise ParameterError(f"{name} names something twice: {', '.join(values)}")
        if not self.robots:
            raise ParameterError("robots is empty; name at least one")
        if len(self.robots) != len(self.odometry_topics):
            raise ParameterError(
                f"robots has {len(self.robots)} entries and odometry_topics {len(self.odometry_topics)}; "
                "give one robot per topic"
            )
        if len(self.edge_robots) not in (1, len(self.edge_topics)):
            raise ParameterError(
                f"edge_robots has {len(self.edge_robots)} entries; give 1, or one per edge topic "
                f"({len(self.edge_topics)})"
            )
        _check_orientations("odometry", self.odometry_sensor_orientations, len(self.odometry_topics))
        _check_orientations("edge", self.edge_sensor_orientations, len(self.edge_topics))
        for entry in self.edge_topics:
            if entry.partition(":")[2] in BRINGS_KEYFRAMES and self.keyframe_source != "edges":
                raise ParameterError(f"edge topic {entry!r} brings keyframes of its own; set keyframe_source to edges")

    def _check_frames(self) -> None:
        if not self.world_frame or self.world_frame.startswith("/"):
            raise ParameterError(
                f"world_frame is {self.world_frame!r}; name the frame of what is published, without a '/' in front: map"
            )
        for entry in self.odometry_topics if self.publish_tf else ():
            if entry.endswith(f":{FRAMELESS_ODOMETRY}"):
                raise ParameterError(
                    f"publish_tf places the odometry's frame, and {entry} has none; use another odometry, or no tf"
                )

    def odometry_sensors(self) -> list[Quaternion]:
        """body_from_sensor of every odometry topic."""
        return _orientations(self.odometry_sensor_orientations, len(self.odometry_topics))

    def edge_sources(self) -> list[Source]:
        """What every edge topic's messages do not say themselves."""
        number = len(self.edge_topics)
        robots = self.edge_robots * (number // len(self.edge_robots))
        sensors = _orientations(self.edge_sensor_orientations, number)
        pairs = zip(robots, sensors, strict=True)
        limits = self.estimator_options().continuity_limits
        return [Source(robot or self.robots[0], self.robots, sensor, limits) for robot, sensor in pairs]

    def estimator_options(self) -> EstimatorOptions:
        """The same as the estimator wants it."""
        return EstimatorOptions(
            keyframe_source=self.keyframe_source,
            unknown_keyframes=self.unknown_keyframes,
            keyframe_angle=math.radians(self.keyframe_angle_deg),
            keyframe_distance=self.keyframe_distance_m,
            keyframe_interval_s=self.keyframe_interval_s,
            stamp_tolerance_s=self.stamp_tolerance_s,
            max_odometry_gap_s=self.max_odometry_gap_s,
            max_turn_rate=math.radians(self.max_turn_rate_deg_s),
            max_speed=self.max_speed_m_s,
            max_stamp_lead_s=self.max_stamp_lead_s,
            on_time_jump=self.on_time_jump,
            time_jump_s=self.time_jump_s,
            max_keyframes=self.max_keyframes,
            max_edges=self.max_edges,
            pending_capacity=self.pending_capacity,
            pending_timeout_s=self.pending_timeout_s,
            gauge=self.gauge,
            method=self.method,
            profile=self.profile,
            device=self.device,
            refinement_steps=None if self.refinement_steps < 0 else self.refinement_steps,
            outlier_threshold=self.outlier_threshold,
            warm_start=self.warm_start,
        )

    def changed(self, values: Mapping[str, Any]) -> NodeParameters:
        """A copy with these values, checked as a whole; names that are not ours are ignored.

        Raises:
            ParameterError: the values do not fit, one by one or together.
        """
        ours = {each.name for each in fields(self)}
        return replace(self, **{name: _python(value) for name, value in values.items() if name in ours})


def _check_orientations(what: str, numbers: tuple[float, ...], topics: int) -> None:
    name = f"{what}_sensor_orientations"
    if len(numbers) not in (4, 4 * topics):
        raise ParameterError(f"{name} has {len(numbers)} numbers; give 4, or 4 per {what} topic ({4 * topics})")
    for start in range(0, len(numbers), 4):
        if not abs(math.hypot(*numbers[start : start + 4]) - 1) <= UNIT_NORM_TOLERANCE:
            raise ParameterError(f"{name}: quaternion {start // 4} is not of unit length")


def _orientations(numbers: tuple[float, ...], topics: int) -> list[Quaternion]:
    """One per topic, from numbers for each or for all."""
    each = [quaternion.normalize(numbers[start : start + 4]) for start in range(0, len(numbers), 4)]
    return each * (topics // len(each))


def _python(value: Any) -> Any:
    return value if isinstance(value, (bool, int, float, str)) else tuple(value)
