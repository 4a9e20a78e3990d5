"""Which stages of the SLAM profile run."""

from __future__ import annotations

from dataclasses import dataclass

# Terms of the posterior, moves and starts of its search, and the networks, each with what is assumed without it.
SWITCHES: dict[str, str] = {
    "cleannet": "the prior probability of a closure comes from its discrepancy with the odometry alone",
    "tree": "the search starts from odometry's orientations, not from CleanNet's tree",
    "fine-net": "the noise of an edge has the density of its kind, whatever its neighbours show",
    "tails": "the errors of good edges are Gaussian",
    "wide-tails": "odometry that errs more than the rest has sixteen times its variance or slipped",
    "near-misses": "the rotations of false closures are uniform over all rotations",
    "vertical": "false closures of a robot that stays upright are wrong by any turn, not only about the vertical",
    "restated": "closures over a few keyframes are measurements, though they do not see odometry's errors",
    "links": "closures over a few keyframes err as other closures do, not as odometry does",
    "repeats": "the errors of false closures are independent",
    "own-repeats": "false closures repeat each other's turns equally often in all runs",
    "label-runs": "closures that follow each other have independent labels",
    "label-bursts": "a closure's label depends on those of its run, not on that of the closure detected before it",
    "common-errors": "the errors of good closures are independent",
    "stated-precisions": "all closures are equally precise, whatever they state",
    "slips": "odometry does not slip",
    "bias": "no gyroscope has a bias",
    "mounting": "the closures' sensor is mounted as stated",
    "turns": "the errors of odometry do not depend on how far it turns",
    "settling": "labels are only flipped; the search never continues from their probabilities",
    "doubts": "good closures of little evidence that support each other are rejected only one at a time",
    "rejected-runs": "good closures of a run that support each other are rejected only one at a time",
    "joins": "chains that closures alone join are never turned, or placed, as wholes by others of these closures",
    "shifts": "a slip stays in the segment in which it was found",
    "splits": "the part between a slip and another place is not turned by itself",
    "mending": "a slip that was found is not taken back together with the labels that it explains",
    "annealing": "no start anneals the closures",
    "robust-start": "no start gives odometry robust weights, as it does closures",
    "minimum-cuts": "no start turns whole parts of the map",
    "tilt": "odometry errs equally about all axes, even where gravity holds roll and pitch",
    "body-axes": "where no vertical is known, turns err equally about all axes of the body",
    "step-errors": "odometry's translations err in proportion to the way, not by a part of each step as well",
    "expected-lengths": "a closure's translation errs with the length that it states, not with the expected one",
    "shift-axes": "closures' translations err alike along all axes of the body",
    "counted-tails": "as many good closures have translations in the tails as the prior says",
    "translations": "closures are judged by their rotations alone",
    "jumps": "odometry's position does not jump while its heading stays right",
    "believed-runs": "closures of a run that make each other seem to join wrong places are believed only one at a time",
    "doubted-runs": "closures of a run that bend the map until they fit are doubted only one at a time",
    "other-beginnings": "no estimate of poses begins once more at closures that were rejected",
    "relabelling": "with translations, rival answers are compared under the labels that rotations alone gave them",
    "rivals": "only the best labelling is published",
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
