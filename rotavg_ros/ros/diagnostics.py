"""How the node is doing, once a second."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from rotavg_ros.online import Answer
from rotavg_ros.online.content import Counts
from rotavg_ros.ros.message_counting import Durations, TopicCounter
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeKind

# An answer that lags behind the graph by more solve periods than this is stale.
_STALE_PERIODS = 10
# Ticks longer ago than this say nothing about the load now.
_RECENT_S = 60.0
_SUSPICIOUS_OUTLIER_SHARE = 0.5
# So long the diagnostics tell of something that has happened once.
_NOTICE_S = 60.0
# What happens when time goes back, by the policy.
TIME_WENT_BACK = {
    "new_component": "time went back: the graph is kept, and a new component begins (on_time_jump)",
    "reset": "time went back: everything is forgotten and begins anew (on_time_jump)",
    "ignore": "time went back: odometry is refused until it is ahead again (on_time_jump)",
    "error": "time went back: odometry is refused until it is ahead again (on_time_jump)",
}
KEPT = "what was forgotten or replaced is kept in"
NOT_KEPT = "what was forgotten or replaced could not be backed up:"
# Refusals that a healthy system produces: a sender that repeats itself.
_HARMLESS = {"duplicate_edge", "marginalized_keyframe"}


@dataclass
class Health:
    """What the node measures about itself. Times are of the monotonic clock, in seconds.

    Attributes:
        odometry, edges: counters per topic name.
        ticks, odometry_callback, odometry_latency: durations; latency from sending to ``orientation``.
        answer: the last one published, and when.
        joins: how often components became one.
        unsolved_since: since when the graph has been ahead of the answer; None if it is not.
        solve_failures: how many ticks failed in all; ``failure`` is the last one's message, None after a good tick.
        save_failure: why the last save failed, None if it did not.
        notices: what has happened to the graph, and when.
    """

    odometry: dict[str, TopicCounter] = field(default_factory=dict)
    edges: dict[str, TopicCounter] = field(default_factory=dict)
    ticks: Durations = field(default_factory=Durations)
    odometry_callback: Durations = field(default_factory=Durations)
    odometry_latency: Durations = field(default_factory=Durations)
    started: float = field(default_factory=time.monotonic)
    last_odometry: float | None = None
    answer: Answer | None = None
    joins: int = 0
    answered: float | None = None
    unsolved_since: float | None = None
    solve_failures: int = 0
    failure: str | None = None
    save_failure: str | None = None
    notices: dict[str, float] = field(default_factory=dict)

    def note(self, notice: str) -> None:
        """Have the diagnostics tell of something for a minute."""
        now = time.monotonic()
        recent = {text: noted for text, noted in self.notices.items() if now - noted < _NOTICE_S}
        self.notices = recent | {notice: now}

    @property
    def lost(self) -> int:
        return sum(counter.lost for counter in self._counters())

    def _counters(self) -> Iterable[TopicCounter]:
        return [*self.odometry.values(), *self.edges.values()]


class Reporter:
    """Turns :class:`Health` into a status; remembers the last report to tell what is new."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._lost = 0
        self._dropped = 0
        self._odometry_received = 0
        self._restarts = 0
        self._reported = time.monotonic()

    def report(self, health: Health, counts: Counts, parameters: NodeParameters, paused: bool) -> DiagnosticStatus:
        """The status now. ERROR: answers do not come; WARN: they may be worse than they could be."""
        now = time.monotonic()
        values = _values(health, counts, paused, now)
        received = sum(counter.received for counter in health.odometry.values())
        rate = (received - self._odometry_received) / max(now - self._reported, 1e-3)
        values["odometry rate hz"] = f"{rate:.1f}"
        values["latest ticks ms"] = " ".join(f"{tick:.1f}" for tick in health.ticks.between_ms(self._reported, now))
        dropped = sum(count for reason, count in counts.rejected.items() if reason not in _HARMLESS)
        errors = _errors(health, parameters, paused, now)
        if counts.time_is_back:
            errors.append("time went back and odometry is refused since; call ~/reset to begin anew")
        warnings = _warnings(health, parameters, paused, now)
        if counts.is_full:
            warnings.append("the graph is full and nothing can be spared: no new keyframes (max_keyframes)")
        if health.lost > self._lost:
            warnings.append(f"{health.lost - self._lost} messages lost")
        if counts.odometry_restarts > self._restarts:
            warnings.append("odometry began anew: a component more until a closure joins it")
        self._restarts = counts.odometry_restarts
        if dropped > self._dropped:
            warnings.append(f"{dropped - self._dropped} inputs refused")
        self._lost, self._dropped, self._odometry_received, self._reported = health.lost, dropped, received, now
        level = DiagnosticStatus.ERROR if errors else DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        return DiagnosticStatus(
            level=level,
            name=self._name,
            message="; ".join(errors + warnings) or ("paused" if paused else "ok"),
            hardware_id=values["device"],
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


def _errors(health: Health, parameters: NodeParameters, paused: bool, now: float) -> list[str]:
    errors = []
    if health.failure is not None:
        errors.append(f"solving fails: {health.failure}")
    patience = _STALE_PERIODS * max(parameters.solve_period_s, 1e-3 * _finite(health.ticks.percentile_ms(95)))
    if health.unsolved_since is not None and not paused and now - health.unsolved_since > patience:
        errors.append(f"the answer is stale by {now - health.unsolved_since:.0f} s")
    return errors


def _warnings(health: Health, parameters: NodeParameters, paused: bool, now: float) -> list[str]:
    warnings = [] if health.save_failure is None else [health.save_failure]
    warnings += [notice for notice, noted in health.notices.items() if now - noted < _NOTICE_S]
    silent = now - (health.started if health.last_odometry is None else health.last_odometry)
    needed = parameters.keyframe_source == "odometry" and parameters.unknown_keyframes == "wait"
    if silent > parameters.odometry_timeout_s and (needed or health.last_odometry is not None):
        warnings.append("no odometry yet" if health.last_odometry is None else f"no odometry for {silent:.0f} s")
    median = health.ticks.median_ms(_RECENT_S)
    if median > 1e3 * parameters.solve_period_s:
        warnings.append(f"a solve takes longer ({median:.0f} ms) than solve_period_s")
    answer = health.answer
    if answer is not None:
        if answer.num_components > 1:
            warnings.append(f"the graph is in {answer.num_components} components")
        closures = answer.kind == EdgeKind.LOOP_CLOSURE
        if closures.any() and answer.outlier[closures].mean() > _SUSPICIOUS_OUTLIER_SHARE:
            warnings.append(f"{100 * answer.outlier[closures].mean():.0f} % of the loop closures are outliers")
        if parameters.device == "cuda" and answer.device == "cpu":
            warnings.append("device cuda was asked for, cpu is used")
    return warnings


def _values(health: Health, counts: Counts, paused: bool, now: float) -> dict[str, str]:
    answer = health.answer
    closures = 0 if answer is None else int((answer.kind == EdgeKind.LOOP_CLOSURE).sum())
    outliers = 0 if answer is None else int(answer.outlier[answer.kind == EdgeKind.LOOP_CLOSURE].sum())
    by_topic = [*health.odometry.values(), *health.edges.values()]
    values = {
        "keyframes": str(counts.keyframes),
        "edges": str(counts.edges),
        "loop closures": str(closures),
        "outliers": str(outliers),
        "components": str(0 if answer is None else answer.num_components),
        "joins": str(health.joins),
        "odometry restarts": str(counts.odometry_restarts),
        "marginalized keyframes": str(counts.marginalized),
        "dropped closures": str(counts.dropped_closures),
        "pending": str(counts.pending),
        "answer version": str(0 if answer is None else answer.version),
        "answer age s": "nan" if health.answered is None else f"{now - health.answered:.1f}",
        "answer cold": "nan" if answer is None else str(answer.was_cold).lower(),
        "ticks": str(health.ticks.count),
        "tick p50 ms": f"{health.ticks.percentile_ms(50):.1f}",
        "tick p95 ms": f"{health.ticks.percentile_ms(95):.1f}",
        "tick max ms": f"{1e3 * health.ticks.longest:.1f}",
        "solve failures": str(health.solve_failures),
        "odometry messages": str(sum(counter.received for counter in health.odometry.values())),
        "odometry callback p95 ms": f"{health.odometry_callback.percentile_ms(95):.2f}",
        "odometry latency p95 ms": f"{health.odometry_latency.percentile_ms(95):.2f}",
        "edge messages": str(sum(counter.received for counter in health.edges.values())),
        "lost messages": str(health.lost),
        "lost by sequence": str(sum(counter.by_sequence.lost for counter in by_topic)),
        "lost by middleware": str(sum(counter.by_middleware.lost for counter in by_topic)),
        "missed before first": str(sum(counter.before_first for counter in by_topic)),
        "dropped": str(sum(counts.rejected.values())),
    }
    values["time jumps"] = str(counts.time_jumps)
    values |= {f"dropped {reason}": str(count) for reason, count in sorted(counts.rejected.items())}
    return values | {
        "device": "none" if answer is None else answer.device,
        "profile": "none" if answer is None else answer.profile,
        "method": "none" if answer is None else answer.method,
        "paused": str(paused).lower(),
        "version": __version__,
    }


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
