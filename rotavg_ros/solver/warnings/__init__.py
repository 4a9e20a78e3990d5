"""Reasons not to trust an answer, each said in one sentence; all functions are pure."""

from rotavg_ros.solver.warnings.flagged import accepted_far_off, mostly_flagged, stating_nothing
from rotavg_ros.solver.warnings.whole_solve import of_whole_solve

__all__ = ["accepted_far_off", "mostly_flagged", "of_whole_solve", "stating_nothing"]
