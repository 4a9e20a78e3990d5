"""Which stages of the SLAM profile run."""

from __future__ import annotations

from dataclasses import dataclass

# Terms of the posterior, moves and starts of its search, and the networks, each with what is assumed without it.
SWITCHES: dict[str, str] = {
    "cleannet": "closures are judged beforehand by their discrepancy with the odometry alone",
    "tree": "the search begins at odometry's orientations, not along CleanNet's tree",
    "fine-net": "all edges of a kind err as the noise's densities have it, whatever their neighbours say",
    "tails": "good edges are Gaussian",
    "wide-tails": "odometry that errs by more than others has sixteen times the variance, or slipped",
    "near-misses": "false closures are uniform over all rotations",
    "vertical": "false closures of a robot that stays upright are wrong by any turn, not by one about the vertical",
    "repeats": "every false closure is wrong by itself",
    "own-repeats": "all runs of false closures repeat their turns as often",
    "label-runs": "closures that follow each other have independent labels",
    "label-bursts": "labels follow those of a closure's own run alone, not that of the closure that was detected last",
    "common-errors": "every closure errs by itself",
    "stated-precisions": "all closures are alike, whatever they state",
    "slips": "odometry does not slip",
    "bias": "no gyroscope has a bias",
    "mounting": "the sensor of closures is mounted as it is said to be",
    "turns": "odometry errs alike however far it turns",
    "settling": "labels are flipped as they are, never gone on from as probabilities",
    "rejected-runs": "good closures of a run that hold each other good are rejected one by one alone",
    "shifts": "a slip, once found, stays in its segment",
    "splits": "what lies between a slip and another place is not turned by itself",
    "mending": "a slip, once found, is not taken back together with what it explains",
    "annealing": "no start anneals the closures",
    "robust-start": "no start weighs odometry down as it does closures",
    "minimum-cuts": "no start turns whole parts",
    "tilt": "odometry errs alike about all axes, though gravity may hold those that the robot tilts about",
    "translations": "closures are judged by their rotations alone",
    "jumps": "odometry's position does not jump while its heading stays",
    "believed-runs": "closures of a run that hold each other to join wrong places are believed one by one alone",
    "doubted-runs": "closures of a run that bend the map until they fit are doubted one by one alone",
    "relabelling": "rivals are compared by places under the labels that rotations alone gave them",
    "rivals": "the best labelling alone is published",
}


@dataclass(frozen=True)
class SlamStages:
    """Switches of the stages; every method contracts the odometry and has a start.

    Attributes:
        clean: CleanNet judges the closures.
        refine: the posterior is searched (:mod:`rotavg_ros.solver.slam.posterior`); otherwise the tree is the answer.
        without: those of :data:`SWITCHES` that are switched off.
    """

    clean: bool = True
    refine: bool = True
    without: frozenset[str] = frozenset()
