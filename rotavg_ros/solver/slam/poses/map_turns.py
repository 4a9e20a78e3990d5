"""Closures that are false by the same turn of the map: a symmetric building seen as if it were turned about its middle.

Such closures agree as one turn about one point, wherever they were seen, and not as one shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.special import expit

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.poses.closures import Predictions, Told
from rotavg_ros.solver.slam.poses.rows import PoseProblem

# Squared widths of what two differ by, in its variance, which is known only about.
_KERNELS = np.array([1.0, 16.0])
# Turns alike up to so many standard deviations; whoever is elsewhere with less than this chance tells nobody anything.
_FARTHEST, _LEAST_CHANCE = 4.0, 0.01


@dataclass(frozen=True)
class MapTurns:
    """By what turn of the map each of C closures is false, if it is, seen from its older end; world frame.

    Attributes:
        turn: ``(4, C)`` unit quaternions.
        shift: ``(C, 3)`` metres, by what the turned map has the newer end elsewhere, …
        place: ``(C, 3)`` … from where it is.
        covariance: ``(C, k + m, k + m)`` of turns and shifts, the closures' own noise included.
        bases: ``(3, k)`` axes of turns and ``(3, m)`` of shifts.
    """

    turn: np.ndarray
    shift: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
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
        source, target = position[drawn.source[closure]], position[drawn.target[closure]]
        # A correction turns bodies from the world, the map the other way.
        forward = quaternion_rows.exp(-turns @ predictions.mean[:, :k].T)
        shift = predictions.mean[:, k:] @ shifts.T
        # Where the newer end is the source: the inverse, F⁻¹ x = Fᵀ (x − target − ε) + target.
        inverse = quaternion_rows.inverse(forward)
        seen = _rotated(inverse, source - target - shift)
        change = np.zeros((len(closure), k + m, k + m))
        change[:, :k, :k], change[:, k:, k:] = -np.eye(k), np.eye(m)
        back = np.stack([_rotated(inverse, np.broadcast_to(axis, source.shape)) for axis in np.eye(3)], axis=2)
        is_back = ~is_forward
        change[is_back, :k, :k] = (turns.T @ back @ turns)[is_back]
        change[is_back, k:, :k] = -(shifts.T @ _crossed(seen) @ back @ turns)[is_back]
        change[is_back, k:, k:] = -(shifts.T @ back @ shifts)[is_back]
        own = np.repeat(np.stack((problem.told.rotation_variance, closure_variance), axis=1), (k, m), axis=1)
        covariance = _with_own(predictions.covariance, np.sqrt(own))
        return cls(
            np.where(is_forward, forward, inverse),
            np.where(is_forward[:, None], shift, seen + target - source),
            np.where(is_forward[:, None], target, source),
            change @ covariance @ change.transpose(0, 2, 1),
            problem.bases,
        )

    def repeats(
        self, elsewhere: np.ndarray, log_alone: np.ndarray, told: Told, *, in_order: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` each: how surely there is one that is turned alike, up to 1; and the density of the shift by these.

        The density is of shifts given the turn, which is counted with the rotations. It is a kernel estimate over other
        closures, each of which stands for all that seem to be off by the turn by which it is (weighed by precision).

        Args:
            elsewhere: ``(C,)`` chance that each joins places that are turned and wrong.
            log_alone: ``(C,)`` nats, density of its shift if no other has to do with it.
            told: whose translations are known, and the order of detection.
            in_order: given those before alone.
        """
        count = len(self.shift)
        chance = elsewhere * told.is_known
        tells = told.detection[chance[told.detection] > _LEAST_CHANCE]
        between = self._differences(*told.detected_near(tells, tells, in_order=False))
        same = expit(between.log_kernel(self) - log_alone[between.rows])
        shape = count, count
        alike = csr_array((same * chance[between.others], (between.rows, between.others)), shape=shape)
        alike = alike + csr_array((chance[tells], (tells, tells)), shape=shape)
        rest()
        each = self._differences(*told.detected_near(np.arange(count), tells, in_order=in_order))
        if len(each.rows) == 0:
            return np.zeros(count), np.zeros(count)
        rest()
        pooled = each.pooled(alike)
        weight = chance[each.others] * np.exp(-pooled.turn_square(self) / 2)
        density = weight * np.exp(pooled.log_kernel(self))
        total = np.bincount(each.rows, weight, count)
        return np.minimum(total, 1.0), np.bincount(each.rows, density, count) / np.maximum(total, 1.0)

    def _differences(self, rows: np.ndarray, others: np.ndarray) -> _Differences:
        """Between closures and what the turns of others would have them be, where turns may be the same."""
        k = self.bases[0].shape[1]
        of_turn = np.trace(self.covariance[:, :k, :k], axis1=1, axis2=2)
        cosine = np.abs(np.einsum("ip,ip->p", self.turn[:, rows], self.turn[:, others]))
        angle = 2 * np.arccos(np.minimum(cosine, 1.0))
        alike = angle**2 < _FARTHEST**2 * (of_turn[rows] + of_turn[others])
        rows, others = rows[alike], others[alike]
        apart = quaternion_rows.multiply(self.turn[:, rows], quaternion_rows.inverse(self.turn[:, others]))
        arm = self.place[rows] - self.place[others]
        turned = _rotated(self.turn[:, others], arm)
        off = self.shift[rows] - self.shift[others] - turned + arm
        lever = self.bases[1].T @ _crossed(turned) @ self.bases[0]
        other = self.covariance[others]
        across = lever @ other[:, :k, k:]
        of_shift = other[:, k:, k:] - across - across.transpose(0, 2, 1)
        of_shift = of_shift + lever @ other[:, :k, :k] @ lever.transpose(0, 2, 1)
        return _Differences(
            rows,
            others,
            quaternion_rows.log(apart).T @ self.bases[0],
            off @ self.bases[1],
            of_turn[others] / k,
            np.trace(of_shift, axis1=1, axis2=2) / of_shift.shape[1],
        )


@dataclass(frozen=True)
class _Differences:
    """Of P pairs of closures, by what one's turn and shift differ from what the other's turn of the map would have.

    Attributes:
        rows, others: ``(P,)`` closures.
        turn, shift: ``(P, k)`` rad and ``(P, m)`` metres.
        turn_variance, shift_variance: ``(P,)`` rad² and m² per component, of what the other says.
    """

    rows: np.ndarray
    others: np.ndarray
    turn: np.ndarray
    shift: np.ndarray
    turn_variance: np.ndarray
    shift_variance: np.ndarray

    def pooled(self, alike: csr_array) -> _Differences:
        """With each other closure standing for all that are like it.

        Args:
            alike: ``(C, C)`` chances that two are off by the same turn, those of the second being so at all.
        """
        weight, k = 1 / self.shift_variance, self.turn.shape[1]
        each = (weight, *(weight * self.turn.T), *(weight * self.shift.T), weight**2 * self.turn_variance)
        # One product for all of them, which stand below each other.
        count, below = len(alike.indptr) - 1, np.arange(len(each))[:, None]
        rows, others = (below * count + self.rows).ravel(), np.tile(self.others, len(each))
        of_rows = csr_array((np.concatenate(each), (rows, others)), shape=(len(each) * count, count))
        over_all = np.asarray((of_rows @ alike.T)[rows, others]).reshape(len(each), -1)
        total, variance = over_all[0], over_all[-1]
        turn, shift = np.split((over_all[1:-1] / total).T, [k], axis=1)
        return _Differences(self.rows, self.others, turn, shift, variance / total**2, 1 / total)

    def turn_square(self, maps: MapTurns) -> np.ndarray:
        """``(P,)`` squares of what turns differ by, in standard deviations."""
        return np.asarray((self._whitened(maps, self.turn[:, :, None]) ** 2).sum(axis=(1, 2)))

    def log_kernel(self, maps: MapTurns) -> np.ndarray:
        """``(P,)`` nats, densities of shifts given by what turns differ, each a mean of several widths."""
        m, k = self.shift.shape[1], self.turn.shape[1]
        own = maps.covariance[self.rows]
        whitened = self._whitened(maps, np.concatenate((self.turn[:, :, None], own[:, :k, k:]), axis=2))
        across = whitened[:, :, 1:].transpose(0, 2, 1)
        off = self.shift[:, :, None] - np.matmul(across, whitened[:, :, :1])
        left = own[:, k:, k:] - np.matmul(across, whitened[:, :, 1:]) + self.shift_variance[:, None, None] * np.eye(m)
        root = inverse_root(left)
        square = (np.matmul(root, off) ** 2).sum(axis=(1, 2))
        log_det = m * np.log(2 * np.pi) - 2 * np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1)
        each = -(square / _KERNELS[:, None] + log_det + m * np.log(_KERNELS[:, None])) / 2
        return np.asarray(np.logaddexp.reduce(each, axis=0) - np.log(len(_KERNELS)))

    def _whitened(self, maps: MapTurns, turns: np.ndarray) -> np.ndarray:
        """``(P, k, n)`` of what goes with turns ``(P, k, n)``, in standard deviations of what these differ by."""
        k = self.turn.shape[1]
        of_turns = maps.covariance[self.rows, :k, :k] + self.turn_variance[:, None, None] * np.eye(k)
        return np.asarray(np.matmul(inverse_root(of_turns), turns))


def _with_own(covariance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """``(C, d, d)`` covariances from samples, of which none may be negative, with closures' own noise ``(C, d)``."""
    scale = sigma[:, :, None] * sigma[:, None, :]
    spread, axes = np.linalg.eigh(covariance / scale)
    return np.asarray(scale * ((axes * (1 + np.maximum(spread, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)))


def _rotated(turn: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """``(n, 3)`` vectors turned by quaternions ``(4, n)``."""
    axis = turn[:3].T
    across = 2 * np.cross(axis, vector)
    return np.asarray(vector + turn[3][:, None] * across + np.cross(axis, across))


def _crossed(vector: np.ndarray) -> np.ndarray:
    """``(n, 3, 3)`` of v ×."""
    return np.asarray(np.cross(vector[:, None, :], np.eye(3)).transpose(0, 2, 1))
