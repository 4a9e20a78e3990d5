"""Turns in units in which all of their components err alike.

A sensor often errs more about one of the body's axes than about others. From the residuals by rotations alone, the
covariance of turns in the body's frame is estimated for closures and for odometry, up to its size. An edge's even turn
is its turn in the world's frame, times the symmetric inverse root of that covariance. The root has determinant 1, so
densities of turns and of even turns are the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.slam.posterior.mode import Mode

# Number of edges for which counts, beforehand, that all axes are alike.
_ALIKE = 10.0


@dataclass(frozen=True)
class EvenTurns:
    """Turns of E edges and even turns, k components each.

    Attributes:
        even: ``(E, k, k)`` from turns to even ones.
        uneven: ``(E, k, k)`` back.
    """

    even: np.ndarray
    uneven: np.ndarray

    @classmethod
    def alike(cls, count: int, turns: int) -> EvenTurns:
        """All axes are alike: even turns are the turns."""
        unit = np.tile(np.eye(turns), (count, 1, 1))
        return cls(unit, unit)

    @classmethod
    def of(cls, mode: Mode) -> EvenTurns:
        """Estimated for odometry and for closures, from a labelling of rotations in space."""
        graph = mode.problem.graph
        bodies = mode.problem.body_from_world(mode.state.correction)
        ends = bodies[graph.source], bodies[graph.target]
        covariance = np.tile(np.eye(3), (len(graph.source), 1, 1))
        for kind in (graph.is_closure, graph.is_odometry):
            rows = np.flatnonzero(kind)
            own = _in_body(mode, rows[mode.state.is_good[rows]], ends)
            # The frame of either end, so that an edge's direction does not matter.
            covariance[rows] = np.mean([at[rows].transpose(0, 2, 1) @ own @ at[rows] for at in ends], axis=0)
        variance, axes = np.linalg.eigh(covariance)
        root = np.sqrt(variance / np.exp(np.log(variance).mean(axis=1, keepdims=True)))[:, None]
        back = axes.transpose(0, 2, 1)
        return cls((axes / root) @ back, (axes * root) @ back)

    @property
    def mean_square(self) -> np.ndarray:
        """``(E,)`` variance of a turn, averaged over components, if that of an even turn is 1."""
        return np.asarray(np.einsum("eij,eij->e", self.uneven, self.uneven) / self.uneven.shape[1])


def _in_body(mode: Mode, rows: np.ndarray, ends: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """``(3, 3)`` covariance, in the body's frame, of some edges' turns in units of their variances.

    Sum of squares over freedom, the rows' redundancy, as if some more edges erred alike about all axes.
    """
    evaluation = mode.evaluation
    weight, left = evaluation.weight[rows], evaluation.residual[rows, :, None]
    freedom = float((1 - weight * evaluation.factorised.resistance[rows]).sum())
    square = np.zeros((3, 3))
    for at in ends:
        turn = np.matmul(at[rows], left)[:, :, 0]
        square += (weight * turn.T) @ turn / 2
    return np.asarray((square + _ALIKE * np.eye(3)) / (max(freedom, 0.0) + _ALIKE))
