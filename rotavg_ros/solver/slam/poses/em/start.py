"""Where an estimate of poses begins."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from rotavg_ros.solver.slam.poses.closures import NOTHING, REPEATS, Places
from rotavg_ros.solver.slam.poses.places.classes import CLASSES
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState

# Solves from a start, at most. An update goes no further: closures that are new pull from its second solve on, and the
# next one goes on from there.
MAX_SOLVES, _MAX_UPDATE_SOLVES = 28, 2
# Variances of shifts to begin with, of odometry and of closures, in those that are believed beforehand.
Level = tuple[float, float]
USUAL: Level = (1.0, 1.0)


@dataclass(frozen=True)
class PoseStart:
    """What an earlier estimate came to.

    Attributes:
        state: key nodes and noise.
        column: ``(C,)`` where the places of each closure are, -1 of those that are new.
        places: as they were judged.
        solves: at most from there.
    """

    state: PoseState
    column: np.ndarray
    places: Places
    solves: int = _MAX_UPDATE_SOLVES

    @classmethod
    def at(cls, pose: PoseMode) -> PoseStart:
        """Of the same labelling."""
        return cls(pose.state, np.arange(len(pose.solved.places.weight)), pose.solved.places, MAX_SOLVES)

    @classmethod
    def beside(cls, pose: PoseMode, problem: PoseProblem) -> PoseStart:
        """Of another labelling, with the noise of a similar one, and places as that one has them.

        Places are judged anew of closures whose rotations are labelled otherwise.
        """
        closure, noise = problem.mode.problem.closure, pose.state.noise
        is_same = problem.mode.state.is_good[closure] == pose.problem.mode.state.is_good[closure]
        column = np.where(is_same, np.arange(len(closure)), -1)
        return cls(replace(along_odometry(problem), noise=noise), column, pose.solved.places, MAX_SOLVES)

    @classmethod
    def believing(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """Of the same labelling, but that some closures ``(n,)`` are right."""
        problem, noise, places = pose.problem, pose.state.noise, pose.solved.places
        chance, weight, rotation = places.chance.copy(), places.weight.copy(), places.rotation_weight.copy()
        chance[:, closures] = 0.0
        chance[0, closures] = 1.0
        weight[closures] = 1 / problem.own_variance(noise)[closures]
        rotation[closures] = 1 / problem.closure_turns(noise)[closures]
        begun = replace(places, chance=chance, weight=weight, rotation_weight=rotation)
        return replace(cls.at(pose), places=begun)

    @classmethod
    def doubting(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """Of the same labelling, but that some closures ``(n,)`` join the same wrong places, turned as they say."""
        places = pose.solved.places
        chance, weight = places.chance.copy(), places.weight.copy()
        chance[:, closures] = 0.0
        chance[REPEATS, closures] = 1.0
        weight[closures] *= NOTHING
        return replace(cls.at(pose), places=replace(places, chance=chance, weight=weight))

    @classmethod
    def kept(cls, problem: PoseProblem, kept: np.ndarray, noise: np.ndarray) -> PoseStart | None:
        """Of labels that are known, and of what is known of places; None if another version of the solver kept it.

        Positions are those of odometry along what rotations say; one solve leads to where closures want them.

        Args:
            problem: the labelling, and translations.
            kept: ``(R, M)`` chances of classes and weights, of the view-graph's first M edges; NaN where not known.
            noise: ``(7,)`` variances.
        """
        if len(kept) != CLASSES + 2 or len(noise) != len(fields(PoseNoise)) or not (noise > 0).all():
            return None
        edge = problem.closures
        is_known = edge < kept.shape[1]
        is_known[is_known] &= ~np.isnan(kept[:, edge[is_known]]).any(axis=0)
        chance, (weight, rotation_weight) = np.split(kept[:, edge[is_known]].astype(np.float64), [CLASSES])
        none, nothing = np.zeros_like(chance), np.zeros(3)
        places = Places(chance, weight, rotation_weight, nothing, nothing, np.zeros(len(weight)), none, none)
        column = np.where(is_known, np.cumsum(is_known) - 1, -1)
        state = replace(along_odometry(problem), noise=PoseNoise(*noise.tolist()))
        return cls(state, column, places, MAX_SOLVES)

    def over(self, places: Places) -> Places:
        """These, and others' ``places`` of what is new."""
        is_new, column = self.column < 0, self.column
        return replace(
            places,
            chance=np.where(is_new, places.chance, self.places.chance[:, column]),
            weight=np.where(is_new, places.weight, self.places.weight[column]),
            rotation_weight=np.where(is_new, places.rotation_weight, self.places.rotation_weight[column]),
        )


def along_odometry(problem: PoseProblem, level: Level = USUAL) -> PoseState:
    """Orientations by rotations alone, positions along odometry, noise at a level of what is believed beforehand."""
    mode = problem.mode
    common = np.zeros((problem.num_runs, 6))
    if problem.turns_share:
        common[:, :3] = mode.state.common
    nowhere = np.zeros((problem.drawn.num_nodes, 3))
    state = PoseState(mode.state.correction, nowhere, common, problem.turn_noise.of_shifts_times(*level))
    return replace(state, position=problem.along_odometry(problem.displacements(problem.orientations(state))))
