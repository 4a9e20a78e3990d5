"""The estimator's options; the node's parameters, their YAML and their table are made of them as well."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rotavg_ros.online.odometry.continuity import ContinuityLimits
from rotavg_ros.online.odometry.keyframe_choice import KeyframePolicy
from rotavg_ros.online.odometry.samples import OdometryBounds
from rotavg_ros.online.odometry.time_jumps import POLICIES
from rotavg_ros.option import (
    DEGREES,
    DEGREES_PER_SECOND,
    METRES,
    METRES_PER_SECOND,
    check_options,
    documented,
    option,
    path_of,
)
from rotavg_ros.solver import DEVICES, PROFILES, TRANSLATION_SCALES
from rotavg_ros.stamps import NANOSECONDS

# Largest number of edges per possible keyframe, its odometry edge included. So closures are bounded by the keyframes,
# even if a robot closes loops between the same few again and again.
EDGES_PER_KEYFRAME = 6


@documented
@dataclass(frozen=True)
class EstimatorOptions:
    """How the graph grows and how it is solved.

    Keyframes that are chosen from odometry are numbered 0, 1, 2 … per robot. Where a front end sends them, one without
    an id gets its stamp as id (the next free number where a keyframe of an earlier time line has that), and odometry
    only carries the newest one on to the present. Edges between keyframes that are chosen from odometry come on top of
    ``max_edges``; a front end's odometry counts. How a graph stays within its bounds:
    :mod:`~rotavg_ros.online.compaction.thinning`.

    Raises:
        OptionError: a value that an option cannot have.
    """

    keyframe_source: str = option(
        "odometry",
        "'odometry': keyframes are chosen from odometry messages; 'edges': a front end sends them as odometry edges",
        choices=("odometry", "edges"),
    )
    unknown_keyframes: str = option(
        "wait", "an edge that names an unknown keyframe waits for it, or creates it", choices=("wait", "create")
    )
    keyframe_angle: float = option(
        5.0, "turn that makes a keyframe; 0 switches the criterion off", within=(0.0, 360.0), live=True, unit=DEGREES
    )
    keyframe_distance: float = option(
        0.5, "way that makes a keyframe; 0 switches the criterion off", within=(0.0, 1e6), live=True, unit=METRES
    )
    keyframe_interval_s: float = option(
        0.0,
        "time that makes a keyframe; 0 switches the criterion off; with all three off every message is one",
        within=(0.0, 1e6),
        live=True,
    )
    stamp_tolerance_s: float = option(
        0.1,
        "how far before the first or after the last odometry an edge's stamp may be",
        within=(0.0, 60.0),
        live=True,
    )
    max_odometry_gap_s: float = option(
        5.0, "between odometry messages farther apart no edge is placed", within=(0.0, 1e6), live=True
    )
    max_turn_rate: float = option(
        360.0,
        "odometry that turns faster has jumped, and begins a new component if it goes on from there; 0: believe all, "
        "a return to zero as well",
        within=(0.0, 1e6),
        live=True,
        unit=DEGREES_PER_SECOND,
    )
    max_speed: float = option(
        50.0,
        "odometry that moves faster has jumped, likewise; 0: any speed",
        within=(0.0, 1e6),
        live=True,
        unit=METRES_PER_SECOND,
    )
    max_stamp_lead_s: float = option(
        60.0,
        "a stamp farther ahead of the last needs a second message to be believed; 0: believe all",
        within=(0.0, 1e9),
        live=True,
    )
    on_time_jump: str = option(
        "new_component",
        "when the data's time goes back (a bag or a simulation that begins again, a clock that was set): keep the "
        "graph and begin a new component; forget everything and begin anew, which suits a bag in a loop; or refuse "
        "odometry until it is ahead again, silently or with an error in the diagnostics",
        choices=POLICIES,
        live=True,
    )
    time_jump_s: float = option(
        1.0, "going back by less is no jump; such odometry is refused as out of order", within=(0.0, 1e6), live=True
    )
    max_odometry_samples: int = option(
        200_000,
        "odometry messages that are kept per robot; beyond it older ones are thinned out",
        within=(1, 100_000_000),
    )
    max_keyframes: int = option(
        200_000,
        "at this many keyframes, those that can best be spared are removed, first without any loss, then with some",
        within=(1, 100_000_000),
        live=True,
    )
    max_edges: int = option(
        2_000_000,
        f"at this many edges, or {EDGES_PER_KEYFRAME} times max_keyframes, the loop closures that can best be spared "
        "are dropped, and odometry's links past the next keyframe",
        within=(1, 1_000_000_000),
        live=True,
    )
    pending_capacity: int = option(
        20_000, "edges that may wait for a keyframe or for odometry; the oldest go first", within=(1, 10_000_000)
    )
    pending_timeout_s: float = option(
        300.0, "how long they may wait, in the data's time of the robot that they wait for", within=(0.0, 1e9)
    )
    gauge: str = option(
        "odometry",
        "orientation of the first keyframe of a component: the odometry's, or identity",
        choices=("odometry", "identity"),
    )
    method: str = option("neurora", "solver, as in `rotavg solve --method`", live=True)
    profile: str = option("auto", "'slam', 'sfm', or by what the edges are", choices=PROFILES, live=True)
    device: str = option("auto", "where the networks run", choices=DEVICES)
    weights: str = option("", "folder of networks that `rotavg train` wrote; those that it lacks are the package's")
    refinement_steps: int = option(
        -1, "refinement steps at most, 0 for none, -1 for the profile's own number", within=(-1, 1000), live=True
    )
    warm_start: bool = option(True, "start from the last answer while data flows", live=True)
    translation_scale: str = option(
        "metric",
        "'metric': translations are in metres and tell wrong places; 'none': they tell positions alone",
        choices=TRANSLATION_SCALES,
        live=True,
    )
    outlier_threshold: float = option(0.5, "an edge with a higher score is an outlier", within=(0.0, 1.0), live=True)

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def for_solver(self) -> dict[str, Any]:
        """What of it :func:`rotavg_ros.solve` is told, by its arguments' names."""
        return {
            "method": self.method,
            "profile": self.profile,
            "device": self.device,
            "refinement_steps": None if self.refinement_steps < 0 else self.refinement_steps,
            "weights": path_of(self.weights),
        }

    @property
    def for_answer(self) -> dict[str, Any]:
        """What of it an answer depends on besides the graph: the solver, its gauge and the flags.

        The others only concern what comes in, or when to solve.
        """
        return self.for_solver | {
            "gauge": self.gauge,
            "translation_scale": self.translation_scale,
            "outlier_threshold": self.outlier_threshold,
        }

    @property
    def most_edges(self) -> int:
        """Edges that the graph may have."""
        return min(self.max_edges, EDGES_PER_KEYFRAME * self.max_keyframes)

    @property
    def needs_odometry(self) -> bool:
        """Whether odometry alone makes keyframes."""
        return self.keyframe_source == "odometry" and self.unknown_keyframes == "wait"

    @property
    def keyframe_policy(self) -> KeyframePolicy:
        return KeyframePolicy(self.keyframe_angle, self.keyframe_distance, _nanoseconds(self.keyframe_interval_s))

    @property
    def odometry_bounds(self) -> OdometryBounds:
        return OdometryBounds(
            tolerance_ns=_nanoseconds(self.stamp_tolerance_s),
            max_gap_ns=_nanoseconds(self.max_odometry_gap_s),
            max_samples=self.max_odometry_samples,
        )

    @property
    def continuity_limits(self) -> ContinuityLimits:
        return ContinuityLimits(
            turn_rate=self.max_turn_rate or math.inf,
            speed=self.max_speed or math.inf,
            lead_ns=_nanoseconds(self.max_stamp_lead_s) or math.inf,
        )

    @property
    def time_jump_ns(self) -> int:
        return _nanoseconds(self.time_jump_s)

    @property
    def pending_timeout_ns(self) -> int:
        return _nanoseconds(self.pending_timeout_s)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * NANOSECONDS)
