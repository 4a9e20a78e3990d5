"""The estimator over hours of driving, in this process and as fast as possible: memory, accuracy, time of a tick.

A robot drives the same course again and again. Its odometry's heading drifts; once a second a place is recognised that
it passed some laps ago, at times falsely.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator, free_memory
from rotavg_ros.stamps import NANOSECONDS

_RATE_HZ = 50
_LAP_S = 200.0
_COURSE_M = (25.0, 15.0)
_DRIFT_DEG_PER_ROOT_S = 0.1
_CLOSURE_EVERY_S = 1.0
_CLOSURE_NOISE_DEG = 1.0
_FALSE_SHARE = 0.2
_TICK_EVERY_S = 10
_ROBOT = "robot"


@dataclass(frozen=True)
class LongRunRow:
    """The state after some hours.

    Attributes:
        hours: hours driven.
        keyframes, edges: in the graph.
        marginalized, dropped_closures: taken out of it so far.
        resident_mb: memory by which the process has grown since its first solve, of a tiny graph.
        bytes_per_item: the same over the keyframes and edges in the graph.
        error_deg: mean of the keyframes in the last answer.
        odometry_error_deg: of the odometry at the same keyframes.
        answer_ms: median CPU time until a tick's answer, since the row before.
        longest_answer_ms: longest wall-clock time until an answer.
        longest_after_ms: longest wall-clock time of the work after an answer.
        message_us: mean CPU time of a message, without ticks.
    """

    hours: float
    keyframes: int
    edges: int
    marginalized: int
    dropped_closures: int
    resident_mb: float
    bytes_per_item: float
    error_deg: float
    odometry_error_deg: float
    answer_ms: float
    longest_answer_ms: float
    longest_after_ms: float
    message_us: float


def table(title: str, rows: list[LongRunRow]) -> Table:
    """The rows as a table."""
    columns = (
        Column("hours", ".1f"),
        Column("keyframes"),
        Column("edges"),
        Column("marginalised"),
        Column("closures dropped"),
        Column("memory MB", ".1f"),
        Column("bytes a keyframe or edge", ".0f"),
        Column("error °", ".2f"),
        Column("odometry's °", ".2f"),
        Column("answer CPU ms", ".0f"),
        Column("longest answer ms", ".0f"),
        Column("longest after it ms", ".0f"),
        Column("message CPU µs", ".1f"),
    )
    return Table(title, columns, tuple(tuple(vars(row).values()) for row in rows))


@dataclass(frozen=True)
class _Course:
    """T odometry messages, ``_RATE_HZ`` a second.

    Attributes:
        heading, drifted: ``(T,)`` true heading and the odometry's, rad.
        position: ``(T, 2)`` of the odometry, metres.
    """

    heading: NDArray[np.float64]
    drifted: NDArray[np.float64]
    position: NDArray[np.float64]

    @classmethod
    def drive(cls, hours: float, rng: np.random.Generator) -> _Course:
        """A figure of eight, repeated."""
        count = max(1, round(3600 * hours * _RATE_HZ))
        phase = 2 * np.pi * np.arange(count + 1) / (_LAP_S * _RATE_HZ)
        step = np.diff(np.stack((_COURSE_M[0] * np.sin(phase), _COURSE_M[1] * np.sin(2 * phase)), axis=1), axis=0)
        heading = np.arctan2(step[:, 1], step[:, 0])
        drift = np.cumsum(rng.normal(scale=np.radians(_DRIFT_DEG_PER_ROOT_S) / np.sqrt(_RATE_HZ), size=count))
        drift -= drift[0]
        cos, sin = np.cos(drift), np.sin(drift)
        turned = np.stack((cos * step[:, 0] - sin * step[:, 1], sin * step[:, 0] + cos * step[:, 1]), axis=1)
        return cls(heading, heading + drift, np.cumsum(turned, axis=0) - turned[0])

    def odometry(self, start: int, end: int) -> Iterator[tuple[int, list[float], list[float]]]:
        """Stamp, orientation and position of messages."""
        half = 0.5 * self.drifted[start:end]
        orientation = np.stack((0 * half, 0 * half, np.sin(half), np.cos(half)), axis=1).tolist()
        position = np.column_stack((self.position[start:end], np.zeros(end - start))).tolist()
        return zip(_stamps(np.arange(start, end)).tolist(), orientation, position, strict=True)

    def closure(self, number: int, now: int, rng: np.random.Generator) -> EdgeMeasurement | None:
        """The place of a message, recognised; None on the first lap."""
        laps = int(now / (_LAP_S * _RATE_HZ))
        if laps == 0:
            return None
        then = now - round(int(rng.integers(1, laps + 1)) * _LAP_S * _RATE_HZ)
        turn = self.heading[then] - self.heading[now] + rng.normal(scale=np.radians(_CLOSURE_NOISE_DEG))
        if rng.random() < _FALSE_SHARE:
            turn = rng.uniform(-np.pi, np.pi)
        source, target = (
            KeyframeReference(_ROBOT, stamp_ns=stamp) for stamp in _stamps(np.array((then, now))).tolist()
        )
        return EdgeMeasurement(number, source, target, Rotation.from_rotvec((0.0, 0.0, turn)).as_quat().tolist())

    def errors_deg(self, answer: Answer) -> tuple[float, float]:
        """Mean error of an answer's keyframes and of the odometry at them, degrees."""
        at = np.rint(answer.stamp_ns * (_RATE_HZ / NANOSECONDS)).astype(np.int64)
        heading = Rotation.from_quat(answer.world_from_body).as_rotvec()[:, 2]
        off = (np.exp(1j * (values - self.heading[at])) for values in (heading, self.drifted[at]))
        answered, odometry = (float(np.degrees(np.abs(np.angle(turn)).mean())) for turn in off)
        return answered, odometry


def run(
    hours: float, max_keyframes: int | None, seed: int = 0, progress: Callable[[LongRunRow], None] = lambda row: None
) -> list[LongRunRow]:
    """Drive for some hours; a row every hour, or ten in shorter runs.

    Args:
        hours: of driving, in the data's time.
        max_keyframes: None: the estimator's default, which runs of about a day do not reach.
        seed: of drift and closures.
        progress: called with every row.
    """
    rng = np.random.default_rng(seed)
    course = _Course.drive(hours, rng)
    defaults = EstimatorOptions()
    online = OnlineEstimator(EstimatorOptions(max_keyframes=max_keyframes or defaults.max_keyframes))
    total = len(course.heading)
    every = round(min(1.0, hours / 10) * 3600 * _RATE_HZ)
    _warm_up()
    free_memory.give_back()  # as ticks of large graphs do
    resident = _resident_bytes()
    rows: list[LongRunRow] = []
    spent = _Spent()
    number = 0
    for start in range(0, total, _RATE_HZ):
        before = time.process_time()
        for stamp_ns, orientation, position in course.odometry(start, min(start + _RATE_HZ, total)):
            online.add_odometry(_ROBOT, stamp_ns, orientation, position)
        now = min(start + _RATE_HZ, total) - 1
        spent.messages += now + 1 - start
        if start // _RATE_HZ % round(_CLOSURE_EVERY_S) == 0:
            edge = course.closure(number, now, rng)
            if edge is not None:
                online.add_edge(edge)
                number, spent.messages = number + 1, spent.messages + 1
        spent.feeding_s += time.process_time() - before
        if start // _RATE_HZ % _TICK_EVERY_S == _TICK_EVERY_S - 1 or now + 1 == total:
            answer = spent.tick(online)
            if answer is not None and (now + 1) // every > len(rows):
                errors_deg = course.errors_deg(answer)
                rows.append(_row(online, (now + 1) / (3600 * _RATE_HZ), resident, errors_deg, spent))
                progress(rows[-1])
                spent = _Spent()
    return rows


@dataclass
class _Spent:
    """Times since the row before: seconds of every tick, and CPU seconds of messages.

    Attributes:
        answer_cpu_s, answer_s, after_s: of each tick, until its answer, and after it.
        feeding_s: CPU time of messages.
        messages: number of messages.
    """

    answer_cpu_s: list[float] = field(default_factory=list)
    answer_s: list[float] = field(default_factory=list)
    after_s: list[float] = field(default_factory=list)
    feeding_s: float = 0.0
    messages: int = 0

    def tick(self, online: OnlineEstimator) -> Answer | None:
        """Do a tick, and what a node does after it."""
        cpu, begun = time.process_time(), time.perf_counter()
        answer = online.tick()
        answered = time.perf_counter()
        self.answer_cpu_s.append(time.process_time() - cpu)
        self.answer_s.append(answered - begun)
        online.go_on()
        self.after_s.append(time.perf_counter() - answered)
        return answer


def _row(
    online: OnlineEstimator, hours: float, resident_at_start: int, errors_deg: tuple[float, float], spent: _Spent
) -> LongRunRow:
    counts = online.counts()
    grown = _resident_bytes() - resident_at_start
    return LongRunRow(
        hours,
        counts.keyframes,
        counts.edges,
        counts.marginalized,
        counts.dropped_closures,
        grown / 1e6,
        grown / (counts.keyframes + counts.edges),
        *errors_deg,
        1e3 * float(np.median(spent.answer_cpu_s)),
        1e3 * max(spent.answer_s),
        1e3 * max(spent.after_s),
        1e6 * spent.feeding_s / spent.messages,
    )


def _warm_up() -> None:
    """Pay a process's one-time costs: networks, pages of code."""
    tiny = OnlineEstimator()
    for index in range(3):
        tiny.add_odometry(_ROBOT, index * NANOSECONDS, (0.0, 0.0, 0.0, 1.0), (index, 0.0, 0.0))
    tiny.add_edge(EdgeMeasurement(0, KeyframeReference(_ROBOT, 0), KeyframeReference(_ROBOT, 2), (0.0, 0.0, 0.0, 1.0)))
    tiny.tick()


def _resident_bytes() -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS"):
            return 1024 * int(line.split()[1])
    raise RuntimeError("the kernel does not say how much memory the process has")


def _stamps(message: NDArray[np.int64]) -> NDArray[np.int64]:
    """Nanoseconds of messages by number."""
    return np.asarray(message * (NANOSECONDS // _RATE_HZ))
