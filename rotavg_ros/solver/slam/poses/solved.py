"""One joint solve, and its predictions of closures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.sparse.block_system import BlockFactor
from rotavg_ros.solver.slam.poses.closures import Places, Predictions, Scale
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.rows import Arms
from rotavg_ros.solver.slam.poses.state import PoseState


@dataclass(frozen=True)
class Solved:
    """A joint solve with E edges, R runs and C closures; d = k + m.

    Attributes:
        state: the state after the step, with the noise used in it.
        way: displacements before the step.
        arms: how the rows' shifts turn with their ends.
        covariance: ``(E, m, m)`` m², of shifts.
        rotation_weight: ``(E, 2)`` rad⁻², of turns about the drift axis and any other one.
        closure_weight: ``(C,)`` m⁻², of closures' even shifts.
        even: ``(C, m, m)`` from closures' shifts to these.
        left: ``(E + R, d, 1)`` whitened residuals after the step.
        factor: factor of its normal equations.
        moved: root mean square of the step, in standard errors of the answer.
        scale: scales of closures' errors.
        predictions: predictions of closures by all else.
        maps: turns of the map that would explain the closures' discrepancies.
        places: the closures' classes that follow.
    """

    state: PoseState
    way: Displacements
    arms: Arms
    covariance: np.ndarray
    rotation_weight: np.ndarray
    closure_weight: np.ndarray
    even: np.ndarray
    left: np.ndarray
    factor: BlockFactor
    moved: float
    scale: Scale
    predictions: Predictions
    maps: MapTurns
    places: Places

    @property
    def closure_root(self) -> np.ndarray:
        """``(C, m, m)`` m⁻¹, root of the weight of each closure's shift."""
        return np.asarray(np.sqrt(self.closure_weight)[:, None, None] * self.even)

    @property
    def closure_back(self) -> np.ndarray:
        """``(C, m, m)`` metres, its inverse."""
        return np.asarray(np.linalg.inv(self.closure_root))


@dataclass(frozen=True)
class PoseMode:
    """A labelling's poses.

    Attributes:
        problem: the graph.
        solved: the last solve.
        cost: −log p of translations given rotations, nats; NaN unless rotations' labels were held.
        first: nats, log density of closures and noise in the first solve (:func:`likeliest_level`).
    """

    problem: PoseProblem
    solved: Solved
    cost: float
    first: float

    @property
    def state(self) -> PoseState:
        """Poses of the key nodes, and the noise."""
        return self.solved.state

    def is_joined_like(self, other: PoseMode) -> bool:
        """Whether the same closures between chains of odometry join the right places."""
        joins = ~self.problem.within_chain
        return self.solved.places.is_like(other.solved.places, joins)

    def jumps_like(self, other: PoseMode) -> bool:
        """Whether odometry's position jumps in the same segments."""
        return np.array_equal(self.problem.jumps > 0, other.problem.jumps > 0)
