"""Errors of positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class RigidFit:
    """A rotation and a shift, ``x ↦ turn x + shift``."""

    turn: Rotation
    shift: FloatArray

    def __call__(self, position: FloatArray) -> FloatArray:
        """Transform positions, ``(n, 3)`` to ``(n, 3)``."""
        return np.asarray(self.turn.apply(position)).reshape(-1, 3) + self.shift


def fit_onto(position: FloatArray, reference: FloatArray) -> RigidFit | None:
    """The rotation and shift that lay n positions onto the reference, least squares without scale (Umeyama 1991).

    Args:
        position, reference: ``(n, 3)`` metres; NaN rows are left out.

    Returns:
        None with fewer than two common positions.
    """
    known = known_rows(position) & known_rows(reference)
    if known.sum() < 2:
        return None
    estimate, target = position[known], reference[known]
    middle, target_middle = estimate.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - target_middle).T @ (estimate - middle))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt
    return RigidFit(Rotation.from_matrix(turn), target_middle - turn @ middle)


def fits_onto(position: FloatArray, reference: FloatArray, component: NDArray[np.int64]) -> dict[int, RigidFit]:
    """:func:`fit_onto` of each component ``(n,)`` with two common positions, by its number."""
    fits = {}
    for number in np.unique(component).tolist():
        members = component == number
        fit = fit_onto(position[members], reference[members])
        if fit is not None:
            fits[number] = fit
    return fits


def position_errors(
    position: FloatArray, reference: FloatArray, component: NDArray[np.int64] | None = None
) -> FloatArray:
    """Distance of n positions to the reference after :func:`fits_onto`, ``(n,)`` metres, NaN where unknown.

    Args:
        position, reference: ``(n, 3)`` metres; NaN rows are unknown.
        component: ``(n,)``; default one component.
    """
    component = np.zeros(len(position), dtype=np.int64) if component is None else component
    distance = np.full(len(position), np.nan)
    for number, fit in fits_onto(position, reference, component).items():
        members = component == number
        distance[members] = np.linalg.norm(fit(position[members]) - reference[members], axis=1)
    return distance


def known_rows(rows: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which rows ``(n, …)`` of positions or orientations are known, ``(n,)``: those without NaN."""
    return np.asarray(np.isfinite(rows).all(axis=1))
