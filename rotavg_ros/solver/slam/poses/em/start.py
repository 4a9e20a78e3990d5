"""Starts of an estimate of poses."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from rotavg_ros.solver.slam.poses.closures import NOTHING, REPEATS, Places, Scale
from rotavg_ros.solver.slam.poses.places.classes import CLASSES
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import closure_turns, initial_noise
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState

# Maximum number of solves from a start, and in an update: there new closures pull from the second solve on, and the
# next update continues.
MAX_SOLVES, _MAX_UPDATE_SOLVES = 28, 2
# Initial variances of shifts, of odometry and of closures, in units of the prior ones.
Level = tuple[float, float]
USUAL: Level = (1.0, 1.0)


@dataclass(frozen=True)
class PoseStart:
    """A start from an earlier estimate.

    Attributes:
        state: key nodes and noise.
        column: ``(C,)`` index of each closure in ``places``, -1 for new closures.
        places: classes as they were judged.
        solves: maximum number of solves from there.
        is_gradual: whether new closures begin to pull little by little, not at once.
    """

    state: PoseState
    column: np.ndarray
    places: Places
    solves: int = _MAX_UPDATE_SOLVES
    is_gradual: bool = False

    @classmethod
    def at(cls, pose: PoseMode) -> PoseStart:
        """From an estimate of the same labelling."""
        return cls(pose.state, np.arange(len(pose.solved.places.weight)), pose.solved.places, MAX_SOLVES)

    @classmethod
    def beside(cls, pose: PoseMode, problem: PoseProblem) -> PoseStart:
        """For another labelling, with the noise and places of a similar one.

        Closures whose rotations are labelled differently are judged anew.
        """
        closure = problem.mode.problem.closure
        is_same = problem.mode.state.is_good[closure] == pose.problem.mode.state.is_good[closure]
        column = np.where(is_same, np.arange(len(closure)), -1)
        return cls(pose.state, column, pose.solved.places, MAX_SOLVES).along_odometry(problem)

    @classmethod
    def believing(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """For the same labelling, with some closures ``(n,)`` believed."""
        begun = with_believed(pose.problem, pose.solved.places, closures, pose.state.noise, pose.solved.scale)
        return replace(cls.at(pose), places=begun)

    @classmethod
    def anew(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """For the same labelling, from rotations alone, with some closures ``(n,)`` believed.

        All others begin to pull little by little.
        """
        begun, column = cls.believing(pose, closures), np.full(len(pose.solved.places.weight), -1)
        column[closures] = closures
        return replace(begun, state=along_odometry(pose.problem), column=column, is_gradual=True)

    @classmethod
    def doubting(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """For the same labelling, with some closures ``(n,)`` held to join the same wrong places, turned as stated."""
        places = pose.solved.places
        chance, weight = places.chance.copy(), places.weight.copy()
        chance[:, closures] = 0.0
        chance[REPEATS, closures] = 1.0
        weight[closures] *= NOTHING
        return replace(cls.at(pose), places=replace(places, chance=chance, weight=weight))

    @classmethod
    def joining(cls, pose: PoseMode, believed: np.ndarray, doubted: np.ndarray) -> PoseStart:
        """For the same labelling, with some closures ``(n,)`` believed, and some ``(d,)`` doubted."""
        begun, held = cls.believing(pose, believed).places, cls.doubting(pose, doubted).places
        is_doubted = np.zeros(len(begun.weight), dtype=bool)
        is_doubted[doubted] = True
        chance, weight = (
            np.where(is_doubted, held.chance, begun.chance),
            np.where(is_doubted, held.weight, begun.weight),
        )
        return replace(cls.at(pose), places=replace(begun, chance=chance, weight=weight))

    def along_odometry(self, problem: PoseProblem) -> PoseStart:
        """The same for another labelling, from rotations alone."""
        state = replace(along_odometry(problem), noise=self.state.noise, shape=self.state.shape)
        return replace(self, state=state)

    @classmethod
    def kept(cls, problem: PoseProblem, kept: np.ndarray, noise: np.ndarray) -> PoseStart | None:
        """From kept labels and classes of places; None if another version of the solver kept them.

        Positions are those of odometry along the orientations; one solve moves them to agree with closures.

        Args:
            problem: the labelling, and translations.
            kept: ``(R, M)`` class probabilities and weights of the view-graph's first M edges; NaN where unknown.
            noise: ``(9,)`` variances.
        """
        if len(kept) != CLASSES + 2 or len(noise) != len(fields(PoseNoise)) or not (noise > 0).all():
            return None
        edge = problem.closures
        is_known = edge < kept.shape[1]
        is_known[is_known] &= ~np.isnan(kept[:, edge[is_known]]).any(axis=0)
        chance, (weight, rotation_weight) = np.split(kept[:, edge[is_known]].astype(np.float64), [CLASSES])
        none, zeros = np.zeros_like(chance), np.zeros(2)
        even, nothing = np.tile(np.eye(problem.shifts), (len(weight), 1, 1)), np.zeros((2, *[problem.shifts] * 2))
        places = Places(
            chance, weight, rotation_weight, zeros, zeros, np.zeros(len(weight)), none, none, even, nothing, none[:2]
        )
        column = np.where(is_known, np.cumsum(is_known) - 1, -1)
        state = replace(along_odometry(problem), noise=PoseNoise(*noise.tolist()))
        return cls(state, column, places, MAX_SOLVES)

    def over(self, places: Places) -> Places:
        """These places, with those of new closures taken from ``places``."""
        known = np.flatnonzero(self.column >= 0)
        column, even = self.column[known], places.even.copy()
        # Else the robot has left the plane.
        if self.places.even.shape[1:] == even.shape[1:]:
            even[known] = self.places.even[column]
        else:
            even[known] = np.eye(even.shape[1])
        chance, weight, rotation = places.chance.copy(), places.weight.copy(), places.rotation_weight.copy()
        chance[:, known] = self.places.chance[:, column]
        weight[known] = self.places.weight[column]
        rotation[known] = self.places.rotation_weight[column]
        return replace(places, chance=chance, weight=weight, rotation_weight=rotation, even=even)


def with_believed(problem: PoseProblem, places: Places, closures: np.ndarray, noise: PoseNoise, scale: Scale) -> Places:
    """Places in which some closures ``(n,)`` are believed, and pull as right ones do."""
    chance, weight, rotation = places.chance.copy(), places.weight.copy(), places.rotation_weight.copy()
    chance[:, closures] = 0.0
    chance[0, closures] = 1.0
    weight[closures] = 1 / scale.own[closures]
    rotation[closures] = 1 / closure_turns(problem, noise)[closures]
    return replace(places, chance=chance, weight=weight, rotation_weight=rotation)


def along_odometry(problem: PoseProblem, level: Level = USUAL) -> PoseState:
    """Orientations by rotations alone, positions along odometry, noise at a level of the prior."""
    mode = problem.mode
    common = np.zeros((problem.num_runs, 6))
    if problem.turns_share:
        common[:, :3] = mode.state.common
    nowhere = np.zeros((problem.drawn.num_nodes, 3))
    state = PoseState(mode.state.correction, nowhere, common, initial_noise(problem).of_shifts_times(*level), np.eye(3))
    return replace(state, position=problem.along_odometry(problem.displacements(problem.orientations(state))))
