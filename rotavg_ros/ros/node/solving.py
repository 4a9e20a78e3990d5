"""Everything slow: ticks, their answers and drawing on one worker's thread; the state file on another's.

A solve may take longer than the time between two autosaves, and a save must not wait for it. Neither does a load, nor a
reset on the executor's thread; these abandon the running solve.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path

from rclpy.node import Node

from rotavg_ros.errors import UserError
from rotavg_ros.online import Answer, Discarded, OnlineEstimator
from rotavg_ros.online.answer.joins import joins
from rotavg_ros.online.state.file import StateFileError, StateFileInUseError, check_kind
from rotavg_ros.online.state.lock import StateFileLock
from rotavg_ros.online.ticks import TICK_WORK, WORK_AFTER, TickAbandonedError
from rotavg_ros.ros.node.diagnostics import KEPT, NOT_KEPT, of_other_robots
from rotavg_ros.ros.node.health import Health
from rotavg_ros.ros.node.intake.forwarding import Forwarding
from rotavg_ros.ros.node.output.outputs import Outputs
from rotavg_ros.ros.node.tick_budget import TickBudget
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.whole_file import remove_leftovers

_LOG_PERIOD_S = 5.0
# Share of a tick's budget that may be spent before its answer.
_BEFORE = TICK_WORK / WORK_AFTER


class Solving:
    """Jobs for the workers, and :meth:`reset`, which takes milliseconds.

    Attributes:
        tick_budget_s: time for the remaining work after a tick's answer, seconds; a share of it applies before the
            answer. Infinite by default.

    Jobs for a service return the message for the caller, or raise.

    Raises:
        UserError: the state file cannot be read or written.
    """

    def __init__(
        self,
        node: Node,
        estimator: OnlineEstimator,
        health: Health,
        outputs: Outputs,
        forwarding: Forwarding,
        parameters: NodeParameters,
    ) -> None:
        self._node = node
        self._estimator = estimator
        self._health = health
        self._outputs = outputs
        self._forwarding = forwarding
        self._parameters = parameters
        self._state_file = state_file = parameters.state_path
        self._budget = TickBudget()
        self.tick_budget_s = math.inf
        self._publishing = threading.Lock()  # an answer goes out before it is forgotten, or not at all
        self._lock: StateFileLock | None = None
        if state_file is not None:
            self._resume(state_file)
        self._saved = self._content()
        self._saved_keyframes = estimator.counts().keyframes

    def tick(self, force_cold: bool = False) -> Answer | None:
        """Solve if there is anything new, and publish the answer; None if there is none."""
        health = self._health
        try:
            answer = self._estimator.tick(force_cold, self._budget.units(_BEFORE * self.tick_budget_s))
        except TickAbandonedError:
            raise
        except Exception as error:
            health.tick_failed(error)
            raise
        health.tick_went_well()
        if answer is not None:
            self._budget.learn(answer.seconds, answer.work)
            self._publish(answer)
        self._forwarding.decide(health.answer)
        if answer is not None:
            self.draw_quietly()
        return answer

    def _go_on(self) -> None:
        """Do the work that the tick has left, once its answer is published."""
        started = time.perf_counter()
        work = self._estimator.go_on(self._budget.units(self.tick_budget_s))
        self._budget.learn_rest(time.perf_counter() - started, work)

    def _tick_and_go_on(self) -> None:
        self.tick()
        self._go_on()

    def solve_now(self) -> str:
        answer = self.tick(force_cold=True)
        if answer is None:
            empty = self._estimator.counts().keyframes == 0
            return "there are no keyframes: nothing to solve" if empty else "nothing has changed since the last answer"
        return f"answer {answer.version}: {len(answer.keyframe_id)} keyframes, {int(answer.outlier.sum())} outliers"

    def reset(self) -> str:
        self._estimator.reset()
        self._forget_answer()
        return "reset"

    def pause(self, paused: bool) -> str:
        self._estimator.pause(paused)
        self._health.waits_for_nothing()
        return "paused: inputs are kept, nothing is solved but by ~/solve_now" if paused else "running"

    def save(self) -> str:
        state_file, content, keyframes = self._own_state_file(), self._content(), self._estimator.counts().keyframes
        self._estimator.save(state_file)
        self._saved, self._saved_keyframes = content, keyframes
        self._health.saved()
        return f"saved to {state_file}"

    def load(self) -> str:
        state_file = self._own_state_file(to_write=False)
        self._estimator.load(state_file)
        self._saved, self._saved_keyframes = self._content(), self._estimator.counts().keyframes
        self._forget_answer()
        self._tell_of_other_robots()
        return f"loaded {self._saved_keyframes} keyframes from {state_file}"

    def tick_quietly(self) -> None:
        """As :meth:`tick`, with the work after it; errors are logged."""
        self._quietly("solving failed: ", self._tick_and_go_on)

    def autosave_quietly(self, at_the_end: bool = False) -> None:
        """Save if anything has changed since the last save; an error is logged once, until saving works again.

        Args:
            at_the_end: save new odometry as well, since the next node compares it with where the robot is then.
        """
        content = self._content()
        moved = at_the_end and self._estimator.counts().keyframes > 0
        if content == self._saved and not moved and self._health.save_failure is None:
            return
        try:
            self.save()
        except Exception as error:
            if str(error) != self._health.save_failure:
                self._node.get_logger().error(str(error))
            self._health.saved(failure=str(error))

    def tell_what_is_lost(self) -> None:
        """Warn at the end, after the last save if there is one, about anything that was not saved."""
        keyframes = self._estimator.counts().keyframes
        if keyframes == 0 or self._content() == self._saved:
            return
        what = f"{keyframes} keyframes are lost that were not saved"
        if self._saved_keyframes:
            what = f"what came after the last save is lost; {self._saved_keyframes} keyframes are in {self._state_file}"
        how = "set autosave_period_s" if self._state_file is not None else "set state_file and autosave_period_s"
        if self._health.save_failure is not None:
            how = "make the state file's folder writable"
        self._node.get_logger().warning(f"{what}; {how} to keep all")

    def back_up_quietly(self, discarded: Discarded) -> None:
        """Back up what was forgotten or replaced beside the state file; the diagnostics report it, or why it failed."""
        if self._state_file is None:
            return
        try:
            notice = f"{KEPT} {discarded.back_up(self._own_state_file())}"
            self._node.get_logger().warning(notice)
        except Exception as error:
            notice = f"{NOT_KEPT} {error}"
            self._node.get_logger().error(notice)
        self._health.note(notice)

    def let_go(self) -> None:
        """Release the state file to other nodes; nothing more is saved."""
        if self._lock is not None:
            self._lock.release()

    def draw_quietly(self) -> None:
        """Draw the last answer for its subscribers; errors are logged."""
        self._quietly("drawing failed: ", lambda: self._outputs.draw(self._health.answer))

    def forget_quietly(self) -> None:
        """Latch empty answers in place of those that the estimator has forgotten; errors are logged."""
        self._quietly("", self._forget_answer)

    def _quietly(self, what: str, job: Callable[[], object]) -> None:
        try:
            job()
        except TickAbandonedError:
            pass
        except Exception as error:  # a correction node that dies takes the robot with it
            self._node.get_logger().error(f"{what}{error}", throttle_duration_sec=_LOG_PERIOD_S)

    def _publish(self, answer: Answer) -> None:
        health = self._health
        with self._publishing:
            if answer.version <= self._estimator.first_version:
                raise TickAbandonedError("abandoned: everything was forgotten or replaced meanwhile")
            self._tell_of_joins(answer)
            self._outputs.publish_answer(answer)
            health.published(answer)

    def _tell_of_joins(self, answer: Answer) -> None:
        health = self._health
        if health.answer is not None and health.answer.version > self._estimator.first_version:
            for join in joins(health.answer, answer):
                health.joined()
                left = f"the graph is in {answer.num_components} components" if answer.num_components > 1 else "all one"
                self._node.get_logger().info(f"{join} ({left})")

    def _forget_answer(self) -> None:
        """The published answers belong to what was forgotten: latch empty ones."""
        with self._publishing:
            answer = self._health.answer
            self._health.begin_anew()
            if answer is not None and answer.version <= self._estimator.first_version:
                self._outputs.publish_answer(answer.without_content())
                self._health.forget_answer()

    def _content(self) -> tuple[int, int]:
        """A value that differs when the graph does."""
        return self._estimator.generation, self._estimator.revision

    def _resume(self, state_file: Path) -> None:
        check_kind(state_file)
        if not state_file.parent.is_dir():
            raise UserError(f"state_file is {state_file}, but there is no folder {state_file.parent}; make it first")
        self._lock = StateFileLock(state_file)
        self._own_state_file(to_write=False)
        try:
            if state_file.exists():
                self._estimator.load(state_file)
        except UserError:
            self.let_go()
            raise
        remove_leftovers(state_file)
        self._tell_of_other_robots()

    def _tell_of_other_robots(self) -> None:
        """Warn if the state file that was read may be another robot's, copied with the parameters."""
        notice = of_other_robots(self._estimator.counts().odometry_robots, self._parameters)
        if notice is not None:
            self._node.get_logger().warning(notice)
            self._health.note(notice)

    def _own_state_file(self, *, to_write: bool = True) -> Path:
        """The state file, which is this node's alone.

        Raises:
            UserError: there is none, another node uses it, or it is to be written and its folder is not writable.
        """
        if self._state_file is None or self._lock is None:
            raise UserError("the parameter state_file is empty; start the node with the file's name")
        try:
            self._lock.acquire()
        except StateFileInUseError:
            raise
        except StateFileError:
            if to_write:
                raise
        return self._state_file
