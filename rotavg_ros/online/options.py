"""The estimator's options."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rotavg_ros.errors import UserError
from rotavg_ros.online.odometry.continuity import ContinuityLimits
from rotavg_ros.online.odometry.keyframe_choice import KeyframePolicy
from rotavg_ros.online.odometry.samples import OdometryBounds
from rotavg_ros.online.odometry.time_jumps import POLICIES

NANOSECONDS = 1_000_000_000


class OptionError(UserError):
    """An option has a value it cannot have."""


@dataclass(frozen=True)
class EstimatorOptions:
    """How the graph grows and how it is solved.

    Attributes:
        keyframe_source: ``odometry``: keyframes are chosen from odometry messages and numbered 0, 1, 2 … per robot;
            ``edges``: a front end chooses them and sends them as odometry edges with ids or stamps (one without an id
            gets its stamp as id), and odometry only carries the newest one on to the present.
        unknown_keyframes: what an edge does that names a keyframe which does not exist (yet): ``wait`` for it, or
            ``create`` it (view-graphs without odometry).
        keyframe_angle, keyframe_distance, keyframe_interval_s: see :class:`KeyframePolicy`; radians, metres, seconds.
        stamp_tolerance_s: how far outside the odometry the stamp of an edge may be.
        max_odometry_gap_s: odometry messages farther apart are not interpolated.
        max_turn_rate, max_speed: odometry that moves faster has jumped; rad/s, m/s; 0: any speed, and no look-out for
            odometry that begins anew.
        max_stamp_lead_s: a stamp farther ahead of the last one needs a second message to be believed; 0: no limit.
        on_time_jump: when the data's time goes back by more than ``time_jump_s`` (a bag that begins again, a clock
            that was set): ``new_component`` keeps everything and begins a new time line, whose keyframes no odometry
            joins to the earlier ones; ``reset`` forgets everything and begins anew; ``ignore`` refuses odometry until
            it is ahead again, ``error`` does too and says so.
        time_jump_s: going back by less is no jump; such odometry is out of order.
        max_odometry_samples: per robot; older messages are thinned out beyond it.
        max_keyframes, max_edges: there the graph does without what can best be spared, see
            :mod:`~rotavg_ros.online.compaction.thinning`; what odometry still needs comes on top of the edges.
        pending_capacity: edges that may wait at a time.
        pending_timeout_s: how long in data time.
        gauge: of the first keyframe of a component: the ``odometry``'s orientation there, or ``identity``.
        method, profile, device, refinement_steps: as in :func:`rotavg_ros.solve`.
        outlier_threshold: an edge with a higher score is an outlier.
        warm_start: start from the previous answer while data flows.
    """

    keyframe_source: str = "odometry"
    unknown_keyframes: str = "wait"
    keyframe_angle: float = math.radians(5.0)
    keyframe_distance: float = 0.5
    keyframe_interval_s: float = 0.0
    stamp_tolerance_s: float = 0.1
    max_odometry_gap_s: float = 5.0
    max_turn_rate: float = math.radians(360.0)
    max_speed: float = 50.0
    max_stamp_lead_s: float = 60.0
    on_time_jump: str = "new_component"
    time_jump_s: float = 1.0
    max_odometry_samples: int = 200_000
    max_keyframes: int = 200_000
    max_edges: int = 2_000_000
    pending_capacity: int = 20_000
    pending_timeout_s: float = 300.0
    gauge: str = "odometry"
    method: str = "neurora"
    profile: str = "auto"
    device: str = "auto"
    refinement_steps: int | None = None
    outlier_threshold: float = 0.5
    warm_start: bool = True

    def __post_init__(self) -> None:
        for name, choices in (
            ("keyframe_source", ("odometry", "edges")),
            ("unknown_keyframes", ("wait", "create")),
            ("gauge", ("odometry", "identity")),
            ("on_time_jump", POLICIES),
        ):
            if getattr(self, name) not in choices:
                raise OptionError(f"{name} is {getattr(self, name)!r}; it must be one of {', '.join(choices)}")
        for name in (
            *("stamp_tolerance_s", "max_odometry_gap_s", "pending_timeout_s"),
            *("max_turn_rate", "max_speed", "max_stamp_lead_s", "time_jump_s"),
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise OptionError(f"{name} is {getattr(self, name)}; it must be finite and not negative")
        for name in ("max_odometry_samples", "max_keyframes", "max_edges", "pending_capacity"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if not 0 <= self.outlier_threshold <= 1:
            raise OptionError(f"outlier_threshold is {self.outlier_threshold}; it must be between 0 and 1")

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
