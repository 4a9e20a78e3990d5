"""How closures between two chains of odometry would move one of them, and which of them agree about that.

A closure between chains states a rigid motion of one against the other. Where the chain lies wrong, each of the right
closures may be off by another shift, since it is seen from another place, and they may all be judged to be turned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.solved import PoseMode

# Two closures agree if they differ by less than this many standard deviations.
_ALIKE = 3.0


@dataclass(frozen=True)
class Motions:
    """How each of n closures between chains would move the chain of the higher number.

    Attributes:
        turn: ``(4, n)`` turn of its corrections; what is drawn in the world turns by the inverse.
        at, to: ``(n, 3)`` metres, the closure's end in that chain, and where the closure says that it is.
        turn_variance: ``(n,)`` rad² per component.
        variance: ``(n,)`` m² per component.
    """

    turn: np.ndarray
    at: np.ndarray
    to: np.ndarray
    turn_variance: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, pose: PoseMode, closures: np.ndarray) -> Motions:
        """Of some closures ``(n,)``."""
        problem, solved, state = pose.problem, pose.solved, pose.state
        drawn, k = problem.drawn, problem.turns
        edge = problem.mode.problem.closure[closures]
        source, target = drawn.source[edge], drawn.target[edge]
        is_onwards = drawn.chain[source] < drawn.chain[target]
        turn = quaternion_rows.residual(state.correction, problem.mode.problem.measured[:, edge], source, target)
        turn = np.where(is_onwards, turn, quaternion_rows.inverse(turn))
        # Displacements are in the axes of the older end, which is in the chain of the lower number and stays.
        way = np.where(is_onwards[:, None], 1.0, -1.0) * solved.way.displacement[edge]
        at = state.position[np.where(is_onwards, target, source)]
        to = state.position[np.where(is_onwards, source, target)] + way
        within = problem.within_chain
        shifts = np.diagonal(solved.predictions.covariance[:, k:, k:], axis1=1, axis2=2).mean(axis=1)
        turns = problem.mode.left_out.predicted[problem.mode.problem.closure]
        shifts, turns = (_of_parts(predicted, within)[closures] for predicted in (shifts, turns))
        return cls(turn, at, to, problem.own[edge] + turns, stated_variance(problem, state)[closures] + shifts)

    def agree(self, turns: int, shifts: int) -> np.ndarray:
        """``(n, n)`` bool, whether two would move the chain alike, halfway between their ends.

        Args:
            turns, shifts: numbers of components, k and m.
        """
        back = quaternion_rows.matrices(quaternion_rows.inverse(self.turn))
        way = (self.at[None] - self.at[:, None]) / 2
        halfway = self.to[:, None] + np.matmul(way, back.transpose(0, 2, 1))
        off = halfway - halfway.transpose(1, 0, 2)
        turn_variance = self.turn_variance[:, None] + self.turn_variance
        variance = self.variance[:, None] + self.variance + turn_variance * (way**2).sum(axis=2)
        angle = quaternion_rows.angle(self.turn.T @ self.turn)
        is_near = (off**2).sum(axis=2) < _ALIKE**2 * shifts * variance
        return np.asarray(is_near & (angle**2 < _ALIKE**2 * turns * turn_variance))


def _of_parts(predicted: np.ndarray, within: np.ndarray) -> np.ndarray:
    """The part of closures' predicted variances ``(C,)`` that is of parts of a chain against each other.

    Where the chain lies as a whole does not matter to whether closures agree about it, and may be quite unknown. Its
    parts are as uncertain as those of chains that closures ``within`` them, ``(C,)`` bool, tell of.
    """
    largest = predicted[within].max() if within.any() else np.inf
    return np.asarray(np.minimum(predicted, largest))
