"""NeuRoRA and its relatives: ``solve`` a :class:`~rotavg_ros.view_graph.ViewGraph`."""

from rotavg_ros.solver.pipeline import DEVICES, METHODS, PROFILES, solve
from rotavg_ros.solver.solution import Solution

__all__ = ["DEVICES", "METHODS", "PROFILES", "Solution", "solve"]
