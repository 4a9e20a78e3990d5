"""NeuRoRA and its relatives: ``solve`` a :class:`~rotavg_ros.view_graph.ViewGraph`, or ``solve_batch`` of many."""

from rotavg_ros.solver.abandonment import Abandoned, abandonable
from rotavg_ros.solver.batch import solve_batch
from rotavg_ros.solver.devices import DEVICES
from rotavg_ros.solver.methods import METHODS
from rotavg_ros.solver.pipeline import PROFILES, solve
from rotavg_ros.solver.solution import Solution

__all__ = ["DEVICES", "METHODS", "PROFILES", "Abandoned", "Solution", "abandonable", "solve", "solve_batch"]
