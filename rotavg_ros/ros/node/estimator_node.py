"""The ROS node: messages in, messages out. Their content is handled in :mod:`rotavg_ros.online`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.executors import Executor
from rclpy.timer import Timer

from rotavg_ros.errors import UserError, in_one_line
from rotavg_ros.online import Discarded, OnlineEstimator
from rotavg_ros.online.compaction import thinning
from rotavg_ros.online.odometry.time_jumps import KEEPS_TIME_LINE
from rotavg_ros.online.solver_process.process import ServerProcess
from rotavg_ros.ros.node import parameter_server
from rotavg_ros.ros.node.diagnostics import TIME_WENT_BACK, Reporter
from rotavg_ros.ros.node.health import Health
from rotavg_ros.ros.node.intake.subscriptions import Subscriptions
from rotavg_ros.ros.node.intake.wiring import Wiring
from rotavg_ros.ros.node.output.outputs import Outputs
from rotavg_ros.ros.node.services import Services
from rotavg_ros.ros.node.solver import Solver
from rotavg_ros.ros.node.solving import Solving
from rotavg_ros.ros.node.worker import Worker, Workers
from rotavg_ros.settings.parameters import NODE_NAME, NodeParameters
from rotavg_ros.solver.methods import check_choices
from rotavg_ros.version import __version__

_SHORT_SOLVE_S = 0.2  # a longer one is not waited for at the end, since nobody would read its answer


class RotavgNode(parameter_server.ParameterNode):
    """Subscriptions, publications, services and timers around an :class:`OnlineEstimator`.

    Callbacks run on the executor's thread and stay short; solving, saving and publishing answers happen on workers.

    Raises:
        UserError: invalid parameters; the message is one line for the user.
    """

    def __init__(
        self,
        executor: Executor,
        process: ServerProcess | None = None,
        on_resuming: Callable[[], object] | None = None,
    ) -> None:
        """Declare the parameters, start the solver and subscribe.

        Args:
            executor: runs the callbacks of the workers' futures.
            process: the process that solves; default: another interpreter, if the parameters ask for one.
            on_resuming: called before the state file is locked; until then there is nothing to clean up.
        """
        try:
            super().__init__(NODE_NAME)
        except Exception as error:  # rclpy has a type of its own for each of its own parameters
            raise UserError(in_one_line(error)) from error
        parameter_server.refuse_repeated(self, sys.argv)
        self._settings = parameters = parameter_server.declare(self)
        self._solver = Solver(parameters, process)
        device = self._solver.warm_up(parameters.estimator)
        self._estimator = OnlineEstimator(
            parameters.estimator, self._solver.solve, self._on_discard, self._solver.advance
        )
        self._health = Health()
        self._reporter = Reporter(f"{self.get_fully_qualified_name().lstrip('/')}: estimator")
        self._worker = Worker(executor, "rotavg_worker")
        self._saver = Worker(executor, "rotavg_saver")
        self._outputs = Outputs(self, parameters, self._estimator)
        listening = Subscriptions(self, parameters, self._estimator, self._health, self._outputs, self._on_time_jump)
        self._listening, self._forwarding = listening, listening.forwarding
        if on_resuming is not None:
            on_resuming()
        self._solving = Solving(self, self._estimator, self._health, self._outputs, self._forwarding, parameters)
        self._solving.tick_budget_s = parameters.tick_budget_s
        workers = Workers(solver=self._worker, saver=self._saver)
        Services(self, listening.label_edge, self._solving, workers, parameters.robots[0])
        self._worker.submit(thinning.load)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # ticks even if /clock is paused or absent
        self._solve_timer = self._create_timer(parameters.solve_period_s, self._on_solve_timer)
        self._create_timer(1.0, self._on_diagnostics_timer)
        if parameters.autosave_period_s > 0:
            self._create_timer(
                parameters.autosave_period_s, lambda: self._saver.submit_once(self._solving.autosave_quietly)
            )
        backward = JumpThreshold(min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=False)
        self._jump_handle = self.get_clock().create_jump_callback(backward, post_callback=self._on_clock_jump)
        parameter_server.watch(self, lambda: self._settings, self._apply)
        topics = ", ".join([*parameters.odometry_topics, *parameters.edge_topics])
        self.get_logger().info(f"rotavg {__version__} on {device}, listening to {topics}")
        if parameters.estimator.device == "cuda" and device == "cpu":
            self.get_logger().warning("there is no CUDA device; the networks run on the CPU")
        self._wiring = Wiring(self, listening.inputs, self._outputs.exclusive_topics)
        self._mistaken_parameters, other_parameters = parameter_server.unknown(self)
        for line in [*self._mistaken_parameters, *other_parameters, *self._outputs.warnings()]:
            self.get_logger().warning(line)

    def close(self, timeout_s: float) -> bool:
        """Save if autosave is on, and stop; False if a save or a solve is still running after the timeout."""
        if self._settings.autosave_period_s > 0:
            self._saver.submit(lambda: self._solving.autosave_quietly(at_the_end=True))
        self._saver.submit(self._solving.tell_what_is_lost)
        is_saved = self._saver.stop(timeout_s, finish=True)
        if is_saved:
            self._solving.let_go()
        is_done = self._worker.stop(_SHORT_SOLVE_S)
        self._solver.close()
        return is_done and is_saved

    def _create_timer(self, period_s: float, callback: Callable[[], object]) -> Timer:
        return self.create_timer(period_s, callback, clock=self._steady)

    def _apply(self, parameters: NodeParameters) -> None:
        """Put changed parameters into force.

        Raises:
            UserError: the solver does not know its options; nothing has changed then.
        """
        old, options = self._settings, parameters.estimator
        # Checked here, since the solver would only report it after the running solve.
        check_choices(options.method, options.profile, options.device)
        if options != self._estimator.options:
            self._estimator.set_options(options)
        self._settings = parameters
        self._outputs.set_parameters(parameters)
        self._forwarding.set_parameters(parameters)
        self._solving.tick_budget_s = parameters.tick_budget_s
        if parameters.solve_period_s != old.solve_period_s:
            self.destroy_timer(self._solve_timer)
            self._solve_timer = self._create_timer(parameters.solve_period_s, self._on_solve_timer)

    def _on_solve_timer(self) -> None:
        self._worker.submit_once(self._solving.tick_quietly)

    def _on_clock_jump(self, jump: TimeJump) -> None:
        """Simulated time went back, which can only happen with ``use_sim_time``."""
        time_jumps, now_ns = self._estimator.time_jumps, self.get_clock().now().nanoseconds
        self._estimator.clock_went_back(now_ns, now_ns - jump.delta.nanoseconds)  # the delta is negative
        if self._estimator.time_jumps != time_jumps:
            self._on_time_jump()

    def _on_time_jump(self) -> None:
        policy = self._settings.estimator.on_time_jump
        self.get_logger().warning(TIME_WENT_BACK[policy])
        if policy not in KEEPS_TIME_LINE:
            self._health.note(TIME_WENT_BACK[policy])
        if policy == "reset":
            self._worker.submit(self._solving.forget_quietly)

    def _on_discard(self, discarded: Discarded) -> None:
        """Runs under the estimator's lock; the saver does it before it saves anything else."""
        self._saver.submit(lambda: self._solving.back_up_quietly(discarded))

    def _on_diagnostics_timer(self) -> None:
        self._health.compared(time.monotonic(), self._estimator.is_behind)
        self._health.waiting_for_frames = self._listening.waiting_for_frames
        wiring = self._wiring.warnings(self._settings)
        self._health.held_back = self._forwarding.waiting
        self._health.held_back_dropped = self._forwarding.dropped
        lines = [*self._mistaken_parameters, *wiring, *self._outputs.warnings(), *self._forwarding.warnings()]
        self._health.noticed(lines)
        status = self._reporter.report(self._health, self._estimator.counts(), self._settings, self._estimator.paused)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
        self._worker.submit_once(self._solving.draw_quietly)
