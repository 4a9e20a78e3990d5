"""Which stages of the SLAM profile run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SlamStages:
    """Every method draws the odometry together and has a start.

    Attributes:
        clean: CleanNet judges the closures.
        refine: the refinement ends the solve.
        tree_start: it starts from the tree of least expected error; otherwise from the odometry.
        scale_estimation: it estimates the noise; otherwise it believes the precisions that edges state.
        group_search: it looks for groups of closures that are false though each by itself looks good.
        slip_search: it looks for slips in the odometry where closures speak of them.
    """

    clean: bool = True
    refine: bool = True
    tree_start: bool = True
    scale_estimation: bool = True
    group_search: bool = True
    slip_search: bool = True
