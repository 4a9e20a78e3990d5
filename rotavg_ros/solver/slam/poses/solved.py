"""One joint solve, and what it tells of each closure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.sparse.block_system import BlockFactor
from rotavg_ros.solver.slam.poses.closures import Places, Predictions, Scale
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.state import PoseState


@dataclass(frozen=True)
class Solved:
    """Of E edges, R runs and C closures; d = k + m.

    Attributes:
        state: after the step, with the noise that it was done with.
        way: displacements before it.
        covariance: ``(E, m, m)`` m², of shifts.
        rotation_weight: ``(E, 2)`` rad⁻², of turns about the drift axis and any other one.
        closure_weight: ``(C,)`` m⁻², of closures' translations.
        left: ``(E + R, d, 1)`` what it leaves of whitened rows.
        factor: of its normal equations.
        moved: root mean square of the step, in standard errors of the answer.
        scale: of closures' errors.
        predictions: what all else says of closures.
        maps: by what turns of the map they are off from that.
        places: their classes, by that.
    """

    state: PoseState
    way: Displacements
    covariance: np.ndarray
    rotation_weight: np.ndarray
    closure_weight: np.ndarray
    left: np.ndarray
    factor: BlockFactor
    moved: float
    scale: Scale
    predictions: Predictions
    maps: MapTurns
    places: Places


@dataclass(frozen=True)
class PoseMode:
    """A labelling's poses.

    Attributes:
        problem: the graph.
        solved: the last solve.
        cost: −log p of translations given what rotations say, nats; NaN unless rotations' labels were held.
        first: nats, what the first solve made of closures and noise (:func:`likeliest_level`).
    """

    problem: PoseProblem
    solved: Solved
    cost: float
    first: float

    @property
    def state(self) -> PoseState:
        """Where the key nodes are, and the noise."""
        return self.solved.state

    def jumps_like(self, other: PoseMode) -> bool:
        """Whether odometry's position jumps in the same segments."""
        return np.array_equal(self.problem.jumps > 0, other.problem.jumps > 0)
