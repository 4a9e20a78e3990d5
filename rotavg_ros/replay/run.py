"""The replay: a bag's messages through the online estimator, which ticks by the bag's clock as the node by its own."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros.bags.reader import BagReader, BagReadError
from rotavg_ros.errors import UserError
from rotavg_ros.inputs import ODOMETRY_CONVERTERS, OdometryRecord
from rotavg_ros.online import Answer, OnlineEstimator
from rotavg_ros.online.content import Counts
from rotavg_ros.online.measurements import OWN_EDGE_ID
from rotavg_ros.replay import left_waiting
from rotavg_ros.replay.feed import Feed
from rotavg_ros.replay.frames import BagFrames
from rotavg_ros.replay.pace import Pace
from rotavg_ros.replay.plan import Plan
from rotavg_ros.replay.record import TickRecord
from rotavg_ros.replay.recording import Recording
from rotavg_ros.stamps import NANOSECONDS

_NAP_S = 0.1


@dataclass(frozen=True)
class Window:
    """The part of a bag to replay, and how fast.

    Attributes:
        start_s: seconds after the bag's beginning.
        duration_s: seconds; None: to the end.
        rate: multiple of real time; 0: as fast as possible.
    """

    start_s: float = 0.0
    duration_s: float | None = None
    rate: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """A replay that came to its end, or that the user stopped.

    Attributes:
        estimator: the estimator with all its inputs.
        answer: the last one; a cold solve.
        ticks: one per answer.
        odometry_stamps_ns: stamps of the odometry messages that were taken, by robot.
        start_ns, end_ns: bag time of the replayed part.
        failures: number of ticks whose solve failed; the last one did not.
        interrupted: whether it was stopped before the end.
        damage: what could not be read of the bag; None: nothing.
        warnings: about how the bag was read, and edges that were not used, a line each.
        wall_seconds: duration of the replay.
    """

    estimator: OnlineEstimator
    answer: Answer
    ticks: tuple[TickRecord, ...]
    odometry_stamps_ns: dict[str, NDArray[np.int64]]
    start_ns: int
    end_ns: int
    failures: int
    interrupted: bool
    damage: str | None
    warnings: tuple[str, ...]
    wall_seconds: float


class ReplayError(UserError):
    """A bag that gave no result; the message says why."""


@dataclass(frozen=True)
class Onlooker:
    """Observes a replay.

    Attributes:
        progress: called with the seconds of bag time that have passed since the last call.
        stop: called between messages; returns whether the user wants to stop.
    """

    progress: Callable[[float], object]
    stop: Callable[[], bool]


def replay(
    bag: BagReader, plan: Plan, window: Window, recording: Path, answer_period_ns: int, onlooker: Onlooker
) -> Outcome:
    """Replay.

    Args:
        bag: open; if it was opened with ``salvage``, the readable part of a damaged bag is replayed.
        plan: the use of its topics.
        window: the part to replay.
        recording: file for what the node would have published.
        answer_period_ns: see :class:`Recording`.
        onlooker: observes the replay.

    Raises:
        BagReadError: a bag that is damaged before anything useful.
        ReplayError: no message, or none from which a keyframe could be made.
    """
    started = time.perf_counter()
    start_ns, stop_ns = bounds(bag, window)
    torch.set_num_threads(plan.parameters.solver_threads or max(1, torch.get_num_threads() - 1))  # as in the node
    estimator = OnlineEstimator(plan.parameters.estimator)
    with Recording(recording, plan.parameters, estimator, answer_period_ns) as recorder:
        loop = _Loop(estimator, plan.pace(), recorder)
        frames = BagFrames(bag, plan)
        feed = Feed(estimator, plan, frames, loop.on_odometry)
        end_ns, interrupted = start_ns, False
        is_whole = start_ns == bag.start_ns and stop_ns == bag.end_ns
        records = bag.decoded(feed.topics, *((None, None) if is_whole else (start_ns, stop_ns)))
        for topic, time_ns, message in records:
            if window.rate > 0:
                _wait_until(started + (time_ns - start_ns) / NANOSECONDS / window.rate, onlooker.stop)
            if interrupted := onlooker.stop():
                break
            loop.advance(time_ns)
            feed(topic, message)
            onlooker.progress((time_ns - end_ns) / NANOSECONDS)
            end_ns = time_ns
        damage = bag.damage
        answer = loop.finish()
    if answer is None and interrupted:
        raise ReplayError(f"{bag.path}: interrupted before the first keyframe; there is nothing to write")
    if answer is None and damage is not None:
        raise BagReadError(damage)
    if answer is None:
        raise ReplayError(f"{bag.path}: {_why_nothing(plan, estimator.counts())}")
    waiting = left_waiting.told(estimator.counts(), _robots_with_odometry(plan))
    return Outcome(
        estimator,
        answer,
        tuple(loop.ticks),
        {robot: np.array(stamps, dtype=np.int64) for robot, stamps in loop.odometry_stamps_ns.items()},
        start_ns,
        end_ns,
        loop.failures,
        interrupted,
        damage,
        tuple(frames.warnings) if waiting is None else (*frames.warnings, waiting),
        time.perf_counter() - started,
    )


class _Loop:
    """The replay's clock, and what happens at its strikes."""

    def __init__(self, estimator: OnlineEstimator, pace: Pace, recorder: Recording) -> None:
        self._estimator, self._recorder, self._pace = estimator, recorder, pace
        self._period_ns = pace.period_ns
        self._now_ns = self._next_tick_ns = 0
        self._last: Answer | None = None
        self.ticks: list[TickRecord] = []
        self.odometry_stamps_ns: dict[str, list[int]] = {}
        self.failures = 0

    def advance(self, time_ns: int) -> None:
        """Let the time pass until a message, with all ticks on the way."""
        if self._next_tick_ns == 0:
            self._next_tick_ns = time_ns + self._period_ns
        while self._next_tick_ns <= time_ns:
            self._now_ns = self._next_tick_ns
            self._next_tick_ns += self._period_ns
            if not self._pace.strikes():
                continue
            if not self._tick() and not self._estimator.is_behind:
                # Nothing will change before the message: skip the strikes until then.
                skipped = max(0, time_ns - self._next_tick_ns) // self._period_ns
                self._next_tick_ns += skipped * self._period_ns
                self._pace.strikes(skipped)
        self._now_ns = time_ns
        self._recorder.diagnostics(time_ns)

    def on_odometry(self, robot: str, record: OdometryRecord) -> None:
        """Note an odometry message that was taken."""
        self.odometry_stamps_ns.setdefault(robot, []).append(record.stamp_ns)
        self._recorder.orientation(self._now_ns, robot, record)

    def finish(self) -> Answer | None:
        """After the last message, make the last answer, a cold solve as in the node; None if there is nothing to solve.

        Raises:
            UserError: from the solver.
        """
        if self._estimator.counts().keyframes:
            self._note(self._estimator.tick(force_cold=True))
        if self._last is not None:
            self._recorder.answer(self._now_ns, self._last, is_last=True)
        return self._last

    def _tick(self) -> bool:
        """Tick; returns whether anything was done."""
        try:
            answer = self._estimator.tick()
            if answer is not None:
                self._recorder.answer(self._now_ns, answer)
            work = self._estimator.go_on()
        except UserError:  # as in the node: the next tick tries again
            self.failures += 1
            return False
        self._pace.spend(0, work)
        return self._note(answer) or work > 0

    def _note(self, answer: Answer | None) -> bool:
        if answer is None:
            return False
        tick = TickRecord(
            stamp_ns=self._now_ns,
            seconds=answer.seconds,
            was_cold=answer.was_cold,
            keyframes=len(answer.keyframe_id),
            edges=len(answer.outlier),
            outliers=int(answer.outlier.sum()),
            flips=0 if self._last is None else _flips(self._last, answer),
        )
        self._pace.spend(tick.keyframes + tick.edges, answer.work)
        self.ticks.append(tick)
        self._last = answer
        return True


def _flips(before: Answer, now: Answer) -> int:
    """Number of edges in both answers whose flags have changed."""
    shared = min(len(before.edge_id), len(now.edge_id))
    if (before.edge_id[:shared] == now.edge_id[:shared]).all():
        return int((before.outlier[:shared] != now.outlier[:shared]).sum())
    # Keyframes were marginalised in between; the estimator's own edges cannot be matched.
    _, old, new = np.intersect1d(before.edge_id, now.edge_id, return_indices=True)
    is_known = now.edge_id[new] != OWN_EDGE_ID
    return int((before.outlier[old] != now.outlier[new])[is_known].sum())


def bounds(bag: BagReader, window: Window) -> tuple[int, int]:
    """First moment to replay and the one after the last. The bag has messages.

    Raises:
        ReplayError: the window begins after the end.
    """
    start_ns = bag.start_ns + round(window.start_s * NANOSECONDS)
    if start_ns >= bag.end_ns:
        raise ReplayError(
            f"{bag.path}: lasts {bag.duration_s:.1f} s, so nothing is left after --start {window.start_s:g}"
        )
    stop_ns = bag.end_ns
    if window.duration_s is not None:
        stop_ns = min(stop_ns, start_ns + round(window.duration_s * NANOSECONDS))
    return start_ns, stop_ns


def _wait_until(moment: float, stop: Callable[[], bool]) -> None:
    """Sleep until a time of ``perf_counter``, in short naps after which ``stop`` is asked."""
    while (left := moment - time.perf_counter()) > 0 and not stop():
        time.sleep(min(left, _NAP_S))


def _robots_with_odometry(plan: Plan) -> list[str]:
    return [robot for robot, _, _ in plan.odometry_of_robots()]


def _why_nothing(plan: Plan, counts: Counts) -> str:
    topics = ", ".join(source.topic for source in (*plan.odometry, *plan.edges))
    refused = ", ".join(f"{count} × {reason}" for reason, count in counts.rejected.items() if count)
    waiting = None if plan.odometry else _without_odometry(plan, counts)
    waiting = waiting or left_waiting.told(counts, _robots_with_odometry(plan))
    why = [f"refused: {refused}"] if refused else []
    why += [waiting] if waiting else []
    why = why or ["none of their messages lies in the replayed part"]
    return f"no keyframe could be made from {topics}; {'; '.join(why)}"


def _without_odometry(plan: Plan, counts: Counts) -> str | None:
    """A warning about closures by stamp in a bag without odometry; None if none wait."""
    if not counts.pending:
        return None
    unfit = [use for use in plan.topics if use.type_name in ODOMETRY_CONVERTERS and use.why_not]
    why_not = "".join(f"; {use.topic}: {use.why_not}" for use in unfit)
    edges = "1 edge names" if counts.pending == 1 else f"{counts.pending} edges name"
    return f"{edges} moments, and no topic was taken for odometry{why_not}"
