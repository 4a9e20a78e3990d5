"""The node's diagnostics, published once a second."""

from __future__ import annotations

import math
import time
from collections.abc import Collection

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from rotavg_ros.online.content import Counts
from rotavg_ros.online.measurements import RejectReason
from rotavg_ros.ros.node.health import Health
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeKind

# An answer that lags behind the graph by more solve periods than this is stale.
_STALE_PERIODS = 10
# Until the first answer this many seconds pass as patience: on a new machine code is compiled, about a minute if idle.
_FIRST_ANSWER_S = 300.0
# Ticks longer ago than this say nothing about the present load.
_RECENT_S = 60.0
# Odometry that has waited longer than this, in the median of the last second, makes all that follows from it late.
_LONG_WAIT_S = 1.0
# Robots' names come from messages and may be anything; only this many are shown.
_MOST_NAMES = 3
# What happens when time goes back, by the policy.
TIME_WENT_BACK = {
    "new_component": "time went back: the graph is kept, and a new component begins (on_time_jump)",
    "reset": "time went back: everything is forgotten and begins anew (on_time_jump)",
    "ignore": "time went back: odometry is refused until it is ahead again (on_time_jump)",
    "error": "time went back: odometry is refused until it is ahead again (on_time_jump)",
}
KEPT = "what was forgotten or replaced is kept in"
NOT_KEPT = "what was forgotten or replaced could not be backed up:"
OTHER_ROBOTS = "the state file is of robots that are not named in robots"
BEGAN_ANEW = (
    "a front end sends other odometry between keyframes whose ids the graph has: if it was started again, none of what "
    "it sends now is about the robot's present way; call ~/reset"
)
FIRST_ANSWER = "the first answer is being worked out; once on a machine code is compiled for it, a minute or two"
# Refusals that occur in a healthy system, where senders repeat themselves.
_HARMLESS = {"duplicate_edge", "marginalized_keyframe"}


class Reporter:
    """Turns :class:`Health` into a status; remembers the last report to recognise what is new."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._lost = 0
        self._dropped: dict[str, int] = {}
        self._odometry_received = 0
        self._restarts = 0
        self._reported = time.monotonic()

    def report(self, health: Health, counts: Counts, parameters: NodeParameters, paused: bool) -> DiagnosticStatus:
        """The present status. ERROR: answers do not come; WARN: they may be worse than they could be."""
        now = time.monotonic()
        values = _values(health, counts, paused, now)
        received = sum(counter.received for counter in health.odometry.values())
        rate = (received - self._odometry_received) / max(now - self._reported, 1e-3)
        values["odometry rate hz"] = f"{rate:.1f}"
        values["latest ticks ms"] = " ".join(f"{tick:.1f}" for tick in health.ticks.between_ms(self._reported, now))
        dropped = {reason: count for reason, count in counts.rejected.items() if reason not in _HARMLESS}
        new = {reason: count - self._dropped.get(reason, 0) for reason, count in dropped.items()}
        new = {reason: count for reason, count in new.items() if count > 0}
        if RejectReason.CONTRADICTORY_ODOMETRY.value in new:
            health.note(BEGAN_ANEW)
        errors = _errors(health, parameters, paused, now)
        if counts.time_is_back:
            errors.append("time went back and odometry is refused since; call ~/reset to begin anew")
        warnings = [*health.mistakes, *_of_waiting(counts, parameters), *_warnings(health, parameters, now)]
        waited = _waited_long(health, parameters, paused, now)
        if waited is not None and _may_compile(health, waited):
            warnings.append(f"{FIRST_ANSWER}, since {waited:.0f} s")
        if counts.queued:
            warnings.append(f"more closures came at once than a tick takes in: {counts.queued} wait to be solved")
        if counts.is_full:
            warnings.append("the graph is full and nothing can be spared: no new keyframes (max_keyframes)")
        if counts.is_full_of_edges:
            warnings.append("the graph is full and no edge can be spared: no new edges (max_edges, max_keyframes)")
        if health.lost > self._lost:
            warnings.append(f"{health.lost - self._lost} messages lost")
        if counts.odometry_restarts > self._restarts:
            warnings.append("odometry began anew: a component more until a closure joins it")
        self._restarts = counts.odometry_restarts
        if new:
            warnings.append(f"{sum(new.values())} inputs refused ({', '.join(sorted(new))})")
        self._lost, self._dropped, self._odometry_received, self._reported = health.lost, dropped, received, now
        level = DiagnosticStatus.ERROR if errors else DiagnosticStatus.WARN if warnings else DiagnosticStatus.OK
        return DiagnosticStatus(
            level=level,
            name=self._name,
            message="; ".join(errors + warnings) or ("paused" if paused else "ok"),
            hardware_id=values["device"],
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


def of_other_robots(known: Collection[str], parameters: NodeParameters) -> str | None:
    """The warning about a state file in which these robots have odometry; None if all are named in the parameters."""
    others = [robot for robot in known if robot not in parameters.robots]
    if not others:
        return None
    names = ", ".join(repr(robot) for robot in others[:_MOST_NAMES])
    return (
        f"{OTHER_ROBOTS} ({names}): if it is another robot's, give this node a state_file of its own, else name them "
        "in robots and odometry_topics"
    )


def _errors(health: Health, parameters: NodeParameters, paused: bool, now: float) -> list[str]:
    errors = []
    if health.failure is not None:
        errors.append(f"solving fails: {health.failure}")
    waited = _waited_long(health, parameters, paused, now)
    if waited is not None and not _may_compile(health, waited):
        errors.append(f"the answer is stale by {waited:.0f} s")
    return errors


def _waited_long(health: Health, parameters: NodeParameters, paused: bool, now: float) -> float | None:
    """Seconds since which the graph has been ahead of the answer; None if that is as usual."""
    patience = _STALE_PERIODS * max(parameters.solve_period_s, 1e-3 * _finite(health.ticks.percentile_ms(95)))
    waited = 0.0 if health.unsolved_since is None or paused else now - health.unsolved_since
    return waited if waited > patience else None


def _may_compile(health: Health, waited: float) -> bool:
    return health.answer is None and waited < _FIRST_ANSWER_S


def _warnings(health: Health, parameters: NodeParameters, now: float) -> list[str]:
    warnings = [] if health.save_failure is None else [health.save_failure]
    warnings += health.recent_notices(now)
    needed = parameters.estimator.needs_odometry
    for topic in health.odometry:
        last = health.last_odometry.get(topic)
        silent = now - (health.started if last is None else last)
        if silent > parameters.odometry_timeout_s and (needed or last is not None):
            refused, reason = health.last_refusal.get(topic, (-math.inf, ""))
            if now - refused <= parameters.odometry_timeout_s:  # it comes, so nobody need look for the driver
                warnings.append(f"all odometry on {topic} has been refused for {silent:.0f} s ({reason})")
            else:
                warnings.append(
                    f"no odometry yet on {topic}" if last is None else f"no odometry for {silent:.0f} s on {topic}"
                )
    waited_s = 1e-3 * health.odometry_wait.median_ms(window_s=1.0)
    if waited_s > _LONG_WAIT_S:
        warnings.append(f"odometry waits {waited_s:.1f} s in its queue: it comes faster than it is taken")
    median = health.ticks.median_ms(_RECENT_S)
    if median > 1e3 * parameters.solve_period_s:
        warnings.append(f"a solve takes longer ({median:.0f} ms) than solve_period_s")
    answer = health.answer
    if answer is not None:
        if answer.num_components > 1:
            warnings.append(f"the graph is in {answer.num_components} components")
        warnings += answer.warnings
        if parameters.estimator.device == "cuda" and answer.device == "cpu":
            warnings.append("device cuda was asked for, cpu is used")
    return warnings


def _of_waiting(counts: Counts, parameters: NodeParameters) -> list[str]:
    """Warnings about edges that wait for something that is unlikely to come."""
    known = {*parameters.robots, *counts.robots}
    unknown = {robot: number for robot, number in counts.pending_by_robot.items() if robot not in known}
    if unknown:
        names = ", ".join(repr(robot) for robot in sorted(unknown)[:_MOST_NAMES])
        return [
            f"{sum(unknown.values())} edges are about robots that are not known ({names}); known are "
            f"{', '.join(sorted(known))}: use these names, or add the robot to robots and odometry_topics"
        ]
    waits_for = counts.longest_pending
    if waits_for is None or counts.longest_pending_s <= parameters.odometry_timeout_s:
        return []
    if waits_for.keyframe_id is not None:
        return [
            f"{counts.pending} edges wait for keyframes, such as {waits_for.keyframe_id} of {waits_for.robot}: who "
            "numbers keyframes needs keyframe_source edges; else name the ends of edges by stamp"
        ]
    return [
        f"{counts.pending} edges wait for odometry of {waits_for.robot} as new as they are: their stamps and the "
        "odometry's must come from one clock (use_sim_time)"
    ]


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
        "queued closures": str(counts.queued),
        "queued closures that agree by chance": str(counts.by_chance),
        "held back": str(health.held_back),
        "held back dropped": str(health.held_back_dropped),
        "waiting for frames": str(health.waiting_for_frames),
        "answer version": str(0 if answer is None else answer.version),
        "answer age s": "nan" if health.answered is None else f"{now - health.answered:.1f}",
        "answer cold": "nan" if answer is None else str(answer.was_cold).lower(),
        "answer behind": str(health.unsolved_since is not None).lower(),
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
