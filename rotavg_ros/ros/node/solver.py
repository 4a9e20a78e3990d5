"""The solver that a node uses: in a process of its own, or in the node's."""

from __future__ import annotations

import torch

from rotavg_ros.online import EstimatorOptions
from rotavg_ros.online.solver_process.client import SolverProcess
from rotavg_ros.online.solver_process.process import ServerProcess
from rotavg_ros.online.ticks import Advance
from rotavg_ros.online.ticks import Solver as Solve
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.view_graph import EdgeKind, ViewGraph


class Solver:
    """What a node's estimator solves with.

    Attributes:
        solve: as :func:`rotavg_ros.solve`.
        advance: as :func:`rotavg_ros.solver.advance`.
    """

    def __init__(self, parameters: NodeParameters, process: ServerProcess | None = None) -> None:
        """Begin with a process of its own, if parameters ask for one.

        Args:
            process: the process that solves; default: another interpreter, if one is needed.
        """
        threads = parameters.solver_threads or max(1, torch.get_num_threads() - 1)
        self._process = SolverProcess(threads, process) if parameters.solver_process else None
        if self._process is None and process is not None:
            process.close()
        self.solve: Solve
        self.advance: Advance
        if self._process is not None:
            self.solve, self.advance = self._process, self._process.advance
            torch.set_num_threads(1)  # what is left to do here is small
        else:
            from rotavg_ros.solver import advance, solve  # loads the networks

            self.solve, self.advance = solve, advance
            torch.set_num_threads(threads)

    def warm_up(self, options: EstimatorOptions) -> str:
        """Solve a triangle, which loads the networks; returns the device.

        Raises:
            UserError: options that the solver does not know.
        """
        triangle = ViewGraph.create(
            [0, 1, 0], [1, 2, 2], [[0.0, 0.0, 0.0, 1.0]] * 3, kind=[EdgeKind.ODOMETRY] * 2 + [EdgeKind.LOOP_CLOSURE]
        )
        return self.solve(triangle, **options.for_solver).device

    def close(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            self._process.close()
