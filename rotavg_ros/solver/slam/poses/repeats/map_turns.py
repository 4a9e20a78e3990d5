"""Closures that are false by the same turn of the map, as in a symmetric building that is seen turned about its centre.

Such closures agree on one turn about one point, wherever they were detected, but not on one shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.poses.closures import Predictions, Told
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.repeats.map_turn_densities import Axes, closure_rows, repeated_after, repeated_density

# Closures that join wrong, turned places with less than this probability are no evidence.
_LEAST_CHANCE = 0.01


@dataclass(frozen=True)
class MapTurns:
    """The turn of the map by which each of C closures is wrong if it is false, seen from its older end; world frame.

    Attributes:
        turn: ``(4, C)`` unit quaternions.
        shift: ``(C, 3)`` metres by which the turned map moves the newer end from its place.
        place: ``(C, 3)`` metres, place of the newer end.
        covariance: ``(C, k + m, k + m)`` of turns and shifts, including the closures' own noise.
        own: ``(C, k + m, k + m)`` of that noise alone, without what closures of a run share.
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
        cls,
        problem: PoseProblem,
        position: np.ndarray,
        predictions: Predictions,
        closure_covariance: np.ndarray,
        common: float,
    ) -> MapTurns:
        """From the deviations of closures from the predictions by all else.

        Args:
            problem: the graph.
            position: ``(K, 3)`` metres, of the key nodes.
            predictions: of closures by all else.
            closure_covariance: ``(C, m, m)`` m², of good closures' shifts.
            common: m² per component, the part of it that closures of a run share.
        """
        closure, (turns, shifts), drawn = problem.mode.problem.closure, problem.bases, problem.drawn
        k, m = turns.shape[1], shifts.shape[1]
        sign = problem.told.sign
        # A correction turns body_from_world; the map turns by its inverse. An edge that is stated from the newer to the
        # older end has the opposite residual, with the same covariance.
        turn = quaternion_rows.exp(-sign * (turns @ predictions.turn(problem.told.uneven).T))
        shift = sign[:, None] * (predictions.mean[:, k:] @ shifts.T)
        change = np.zeros((len(closure), k + m, k + m))
        change[:, :k, :k], change[:, k:, k:] = -problem.told.uneven, np.eye(m)
        noise = np.zeros_like(change)
        noise[:, :k, :k] = problem.told.rotation_variance[:, None, None] * np.eye(k)
        noise[:, k:, k:] = closure_covariance
        own = noise.copy()
        own[:, k:, k:] -= common * np.eye(m)
        back_turned = change.transpose(0, 2, 1)
        return cls(
            turn,
            shift,
            position[np.where(sign > 0, drawn.target[closure], drawn.source[closure])],
            change @ (predictions.covariance + noise) @ back_turned,
            change @ own @ back_turned,
            problem.bases,
        )

    def repeats(
        self, elsewhere: np.ndarray, log_alone: np.ndarray, told: Told, asked: np.ndarray, *, in_order: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` expected number of others that are turned alike, at most 1; ``(C, W)`` densities of shifts by these.

        Densities are of shifts, given the turn, which counts with the rotations; there is one per width. They are
        kernel estimates over other closures, each represented by the mean of all that seem to be off by the same turn
        (weighted by precision).

        Args:
            elsewhere: ``(C,)`` probability that each joins wrong places that are turned.
            log_alone: ``(C,)`` nats, log density of its shift without any relation to another closure.
            told: whose translations are known, and the order of detection.
            asked: ``(C,)`` bool, the closures to compute; the others get zeros.
            in_order: whether only closures detected before are evidence.
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
        """``(2, P, W)`` densities of shifts, given turns: of the later closure by the earlier one, and vice versa.

        The errors of the predictions for two closures that follow each other are about the same, so they do not count.

        Args:
            later, earlier: ``(P,)`` closures.
        """
        return repeated_after(closure_rows(self.turn, self.shift, self.place, self.own), self._axes, later, earlier)

    @property
    def _axes(self) -> Axes:
        return Axes(*(np.ascontiguousarray(basis) for basis in self.bases))
