"""The content that an estimator has now, and what takes its place: what inputs and ticks share.

The estimator has two locks:

- :attr:`CurrentContent.lock` guards the :class:`CurrentContent` and everything that its content reaches. Every input,
  query and change holds it, mostly for microseconds. A tick holds it while it copies its problem, while it reads where
  its answer is anchored, and while it hands in its answer, but not while it solves. Nobody holds it while a state file
  is read or written. ``on_discard`` is called with it held.
- The lock of :class:`~rotavg_ros.online.ticks.Ticks` is held during a whole tick, and during the work after one. So
  these run one at a time, and each finds the answer and the solver's memory that the one before has left, unless the
  content or the options were replaced. It also guards the unfinished work in the solver's memory, which goes on without
  the first lock.

A thread that needs both takes the lock of the ticks first. The options, the counters, :attr:`CurrentContent.paused`
and :attr:`RunningTick.abandoned_by` may be read without a lock; they are changed under the first.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from rotavg_ros.online.content import Content, ContentState
from rotavg_ros.online.measurements import OdometryMessage, RejectReason
from rotavg_ros.online.odometry.time_jumps import TimeBefore
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.state.discarded import Discarded


class RunningTick:
    """A tick that is running, or the work after one.

    Attributes:
        is_forced: somebody has asked for its answer.
        abandoned_by: what made its answer worthless; None as long as it is wanted.
    """

    def __init__(self, is_forced: bool) -> None:
        self.is_forced = is_forced
        self.abandoned_by: str | None = None

    def is_abandoned(self) -> bool:
        return self.abandoned_by is not None


class CurrentContent:
    """The content, and the tick that is running on it.

    Callers of its methods hold :attr:`lock`; the methods do not take it themselves.

    Attributes:
        lock: guards everything here, see the module's docstring.
        options: the estimator's.
        content: replaced as a whole by :meth:`replace` and :meth:`forget`.
        generation: counts how often it was.
        time_jumps: counts how often the data's time went back.
        paused: whether ticks do nothing, unless forced.
    """

    def __init__(self, options: EstimatorOptions, on_discard: Callable[[Discarded], None] | None = None) -> None:
        """Start empty.

        Args:
            on_discard: called with every content that is forgotten or replaced, unless it is empty.
        """
        self.lock = threading.Lock()
        self.options = options
        self.content = Content(ContentState.begin(options))
        self.generation = 0
        self.time_jumps = 0
        self.paused = False
        self._on_discard = on_discard
        self._running: RunningTick | None = None
        self._time_before: TimeBefore | None = None

    def add_odometry(self, message: OdometryMessage) -> RejectReason | None:
        """Take an odometry message; where it shows that time went back, the options decide what happens.

        Returns:
            why it was refused and counted; None if it was taken.
        """
        if self._time_before is not None and self._time_before.has(message.robot, message.stamp_ns):
            return self.content.state.growth.refuse(RejectReason.OUT_OF_ORDER_ODOMETRY)
        reason, since_jump = self.content.add_odometry(message)
        if not since_jump:
            return reason
        self.time_jumps += 1
        if self.options.on_time_jump == "new_component":
            self.content.builder.begin_time_line(message.robot, len(since_jump))
        elif self.options.on_time_jump == "reset":
            self.forget()
        else:
            return reason
        return [self.content.add_odometry(message)[0] for message in since_jump][-1]

    def clock_went_back(self, now_ns: int, from_ns: int | None) -> None:
        """The clock that stamps the data went back, see :meth:`OnlineEstimator.clock_went_back`; the options decide."""
        if from_ns is not None and from_ns - now_ns <= self.options.time_jump_ns:
            return  # two that publish the clock, or messages that overtake each other
        tracks, data_time_ns = self.content.builder.tracks, self.content.state.growth.newest_ns
        if data_time_ns is None or data_time_ns - now_ns <= self.options.time_jump_ns:
            return  # no data from after it are known, or odometry has shown the jump already
        if self.options.on_time_jump == "reset":
            self.time_jumps += 1
            latest = ((robot, track.latest) for robot, track in tracks.items())
            latest_ns = {robot: sample.stamp_ns for robot, sample in latest if sample is not None}
            self.forget()
            until_ns = data_time_ns if from_ns is None else from_ns
            self._time_before = TimeBefore(latest_ns, until_ns, self.options.time_jump_ns)
        elif self.options.on_time_jump == "new_component":
            self.time_jumps += self.content.builder.clock_went_back(now_ns)

    def set_options(self, options: EstimatorOptions) -> None:
        """Change the options; what was built so far stays. If answers depend on them, the next tick solves anew."""
        is_answer_other = options.for_answer != self.options.for_answer
        self.options = options
        self.content.builder.set_options(options)
        if is_answer_other:
            self.content.solve_anew()

    def forget(self) -> None:
        """Begin with an empty content, whose answers go on counting up."""
        self.replace(ContentState.begin(self.options, self.content.version))

    def replace(self, state: ContentState) -> None:
        """Begin with this content; the one before is handed to ``on_discard`` unless it is empty."""
        discarded = Discarded(self.content.state)
        self.generation += 1
        self._time_before = None
        self.content = Content(state)
        self.content.builder.set_options(self.options)  # they may have changed while a file was read
        self._abandon_tick("everything was forgotten or replaced meanwhile")
        if self._on_discard is not None and discarded.num_keyframes:
            self._on_discard(discarded)

    def begin_tick(self, is_forced: bool) -> RunningTick:
        """The tick that begins now, or the work after one: the one that is abandoned from now on."""
        self._running = RunningTick(is_forced)
        return self._running

    def pause(self, paused: bool) -> None:
        """Pause ticks, and abandon a running one unless it is forced; or let them go on."""
        self.paused = paused
        if paused and self._running is not None and not self._running.is_forced:
            self._abandon_tick("paused meanwhile")

    def _abandon_tick(self, why: str) -> None:
        """Make the running tick, if there is one, end soon and change nothing."""
        if self._running is not None:
            self._running.abandoned_by = why
