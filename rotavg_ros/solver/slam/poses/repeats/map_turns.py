"""Closures that are false by the same turn of the map: a symmetric building seen as if turned about its centre.

Such closures agree on one turn about one point, wherever they were detected, and not on one shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.poses.closures import Predictions, Told
from rotavg_ros.solver.slam.poses.repeats.map_turn_densities import Axes, closure_rows, repeated_after, repeated_density
from rotavg_ros.solver.slam.poses.rows import PoseProblem

# Whoever is elsewhere with less than this chance tells nobody anything.
_LEAST_CHANCE = 0.01


@dataclass(frozen=True)
class MapTurns:
    """By what turn of the map each of C closures is false, if it is, seen from its older end; world frame.

    Attributes:
        turn: ``(4, C)`` unit quaternions.
        shift: ``(C, 3)`` metres, by what the turned map has the newer end elsewhere, …
        place: ``(C, 3)`` … from where it is.
        covariance: ``(C, k + m, k + m)`` of turns and shifts, the closures' own noise included.
        own: ``(C, k + m, k + m)`` of that noise alone.
        bases: ``(3, k)`` axes of turns and ``(3, m)`` of shifts.
    """

    turn: np.ndarray
    shift: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
    own: np.ndarray
    bases: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(
        cls, problem: PoseProblem, position: np.ndarray, predictions: Predictions, closure_variance: np.ndarray
    ) -> MapTurns:
        """By what closures are off from what all else says.

        Args:
            problem: the graph.
            position: ``(K, 3)`` metres, of the key nodes.
            predictions: what all else says.
            closure_variance: ``(C,)`` m² per component, of good closures.
        """
        closure, (turns, shifts), drawn = problem.mode.problem.closure, problem.bases, problem.drawn
        k, m = turns.shape[1], shifts.shape[1]
        is_forward = problem.told.sign > 0
        # A correction turns bodies from the world, the map the other way.
        turn = quaternion_rows.exp(-turns @ predictions.mean[:, :k].T)
        shift = predictions.mean[:, k:] @ shifts.T
        change = np.zeros((len(closure), k + m, k + m))
        change[:, :k, :k], change[:, k:, k:] = -np.eye(k), np.eye(m)
        # Where the newer end is the source: the other way round, F⁻¹. Translations are the older end's in any case.
        is_back = np.flatnonzero(~is_forward)
        inverse = quaternion_rows.inverse(turn[:, is_back])
        turn[:, is_back], shift[is_back] = inverse, -shift[is_back]
        change[is_back, :k, :k] = turns.T @ quaternion_rows.matrices(inverse) @ turns
        change[is_back, k:, k:] *= -1
        own = np.repeat(np.stack((problem.told.rotation_variance, closure_variance), axis=1), (k, m), axis=1)
        noise = own[:, :, None] * np.eye(k + m)
        back_turned = change.transpose(0, 2, 1)
        return cls(
            turn,
            shift,
            position[np.where(is_forward, drawn.target[closure], drawn.source[closure])],
            change @ (predictions.covariance + noise) @ back_turned,
            change @ noise @ back_turned,
            problem.bases,
        )

    def repeats(
        self, elsewhere: np.ndarray, log_alone: np.ndarray, told: Told, asked: np.ndarray, *, in_order: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` how surely there is one that is turned alike, up to 1; ``(C, W)`` densities of shifts by these.

        Densities are of shifts given the turn, which is counted with the rotations, and of so many widths. They are
        kernel estimates over other closures, each of which stands for all that seem to be off by the turn by which it
        is (weighed by precision).

        Args:
            elsewhere: ``(C,)`` chance that each joins places that are turned and wrong.
            log_alone: ``(C,)`` nats, density of its shift if no other has to do with it.
            told: whose translations are known, and the order of detection.
            asked: ``(C,)`` bool, of which: zeros of the others.
            in_order: given those before alone.
        """
        chance = elsewhere * told.is_known
        tells = told.detection[chance[told.detection] > _LEAST_CHANCE]
        rest()
        among, of_all = (
            told.detected_near(rows, tells, in_order=alone)
            for rows, alone in ((tells, False), (np.flatnonzero(asked), in_order))
        )
        turned = closure_rows(self.turn, self.shift, self.place, self.covariance)
        return repeated_density(turned, self._axes, chance, log_alone, among, of_all)

    def repeats_after(self, later: np.ndarray, earlier: np.ndarray) -> np.ndarray:
        """``(2, P, W)`` densities of shifts given turns: of the later of two by the earlier one, and the other way.

        What all else says of two that follow each other is off by about the same, and does not count.

        Args:
            later, earlier: ``(P,)`` closures.
        """
        return repeated_after(closure_rows(self.turn, self.shift, self.place, self.own), self._axes, later, earlier)

    @property
    def _axes(self) -> Axes:
        return Axes(*(np.ascontiguousarray(basis) for basis in self.bases))
