"""Which stages of the SLAM profile run."""

from __future__ import annotations

from dataclasses import dataclass

# Terms of the posterior, moves and starts of its search, and the network, each with what is left without it.
SWITCHES: dict[str, str] = {
    "cleannet": "closures are judged beforehand by their discrepancy with the odometry alone",
    "tree": "the search begins at odometry's orientations, not along CleanNet's tree",
    "fine-net": "all edges of a kind err as the noise's densities have it, whatever their neighbours say",
    "tails": "good edges are Gaussian",
    "near-misses": "false closures are uniform over all rotations",
    "repeats": "every false closure is wrong by itself",
    "label-runs": "closures that follow each other have independent labels",
    "common-errors": "every closure errs by itself",
    "stated-precisions": "all closures are alike, whatever they state",
    "slips": "odometry does not slip",
    "bias": "no gyroscope has a bias",
    "turns": "odometry errs alike however far it turns",
    "mending": "a slip, once found, is not taken back together with what it explains",
    "annealing": "no start anneals the closures",
    "robust-start": "no start weighs odometry down as it does closures",
    "minimum-cuts": "no start turns whole parts",
    "translations": "closures are judged by their rotations alone",
    "rivals": "the best labelling alone is published",
}


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
        posterior: one posterior is searched (:mod:`rotavg_ros.solver.slam.posterior`) instead of the passes above.
        without: what of :data:`SWITCHES` is switched off in it.
    """

    clean: bool = True
    refine: bool = True
    tree_start: bool = True
    scale_estimation: bool = True
    group_search: bool = True
    slip_search: bool = True
    posterior: bool = False
    without: frozenset[str] = frozenset()
