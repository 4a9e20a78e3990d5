"""Closures' shifts in units in which all of their components err alike.

A scanner in a corridor tells its place along the walls worse than between them. So the part of good closures' errors
that does not grow with their length has a shape in the body's frame, of determinant 1, beside its size. The even shift
is the shift in the world's frame, times the symmetric inverse root of the whole covariance, scaled to determinant 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import eigh

# Number of closures for which counts, beforehand, that all axes are alike.
_ALIKE = 10.0


@dataclass(frozen=True)
class EvenShifts:
    """Shifts of C closures and even shifts, m components each.

    Attributes:
        even: ``(C, m, m)`` from shifts to even ones.
        uneven: ``(C, m, m)`` back.
        frame: ``(C, m, m)`` from the body's axes in which the shape is stated to those of shifts.
        size: ``(C,)`` variance of an even shift, if that of a shift is 1 in the geometric mean over the shape's axes.
        shape: ``(m, m)`` in the body's axes.
    """

    even: np.ndarray
    uneven: np.ndarray
    frame: np.ndarray
    size: np.ndarray
    shape: np.ndarray

    @classmethod
    def alike(cls, count: int, shifts: int) -> EvenShifts:
        """All axes are alike: even shifts are the shifts."""
        unit = np.tile(np.eye(shifts), (count, 1, 1))
        return cls(unit, unit, unit, np.ones(count), np.eye(shifts))

    @classmethod
    def of(cls, shape: np.ndarray, frame: np.ndarray, share: np.ndarray) -> EvenShifts:
        """From a shape ``(m, m)`` in the body's axes, these axes ``(C, m, m)``, and the share ``(C,)`` that has it.

        What else a shift errs by is alike along all axes.
        """
        shaped, unit = frame @ shape @ frame.transpose(0, 2, 1), np.eye(len(shape))
        variance, axes = eigh(unit + share[:, None, None] * (shaped - unit))
        size = np.exp(np.log(variance).mean(axis=1))
        root = np.sqrt(variance / size[:, None])[:, None]
        back = axes.transpose(0, 2, 1)
        return cls((axes / root) @ back, (axes * root) @ back, frame, size, shape)


def likeliest_shape(shape: np.ndarray, squares: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """``(m, m)`` shape from residuals and their redundancy, as if some more closures erred alike about all axes.

    Args:
        shape: ``(m, m)`` before.
        squares, freedom: ``(m, m)`` in the body's axes: sums of Σ⁻¹ x xᵀ Σ⁻¹ and of Σ⁻¹, with shifts x of covariance Σ,
            each times the variance of what has the shape.
    """
    root = _power(shape, 0.5)
    squares, freedom = root @ squares @ root, root @ freedom @ root
    count = float(np.trace(freedom)) / len(shape)
    least = np.finfo(np.float64).eps * count + np.finfo(np.float64).tiny
    alone = root @ _power(freedom + least * np.eye(len(shape)), -0.5)
    found = count * alone @ squares @ alone.T + _ALIKE * np.eye(len(shape))
    found = (found + found.T) / 2
    return np.asarray(found / np.linalg.det(found) ** (1 / len(shape)))


def log_shape_prior(shape: np.ndarray) -> float:
    """Log prior of a shape, nats, up to a constant."""
    return -_ALIKE / 2 * float(np.trace(np.linalg.inv(shape)) - len(shape))


def shape_change(after: np.ndarray, before: np.ndarray) -> float:
    """Largest absolute change of the logarithm of any direction's variance."""
    back = _power(before, -0.5)
    return float(np.abs(np.log(np.linalg.eigvalsh(back @ after @ back))).max())


def _power(matrix: np.ndarray, power: float) -> np.ndarray:
    value, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * value**power) @ axes.T)
