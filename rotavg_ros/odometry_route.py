"""What odometry did between the ends of an edge that several of its steps were drawn together into.

Keyframes that no closure touches are marginalised: an edge then says where all of its steps together lead, and by
``steps`` how many they were. How they got there matters as well: odometry that errs in turns errs by the squares of all
turns, not by that of their sum; and a step's translation turns with all that is corrected before it. So an edge keeps
sums of its steps. With the older end's axes, d_i the i-th step's displacement, P_i = d_1 + … + d_i where it ends, and
g_i the share of the steps' variance before it,

    lag = Σ g_i d_i ,    spread = the covariance of all P_i, whose mean is  D − lag ,  D = P_n .

and, with W_i the older end's axes seen from the body where step i begins, J_i = W_1 + … + W_{i-1},

    by_bias = Σ W_i ,    shift_by_bias = Σ [J_i ·] × d_i ,

which say how a bias of the gyroscope turned and moved it. That is all that ``solver/slam`` asks of an edge's steps, to
first order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

_SYMMETRIC = np.triu_indices(3)
#: Numbers of an edge: turned, way, lag (3), the upper triangle of spread (6), by_bias (9), shift_by_bias (9).
ROUTE_COLUMNS = 29

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Routes:
    """Of M edges of odometry, by the axes of their older ends.

    Attributes:
        turned: ``(M,)`` rad², the sum of the squares of the steps' turns.
        way: ``(M,)`` metres, the sum of the steps' lengths.
        lag: ``(M, 3)`` metres, Σ g_i d_i; 0 of a single step, which is measured where it begins.
        spread: ``(M, 3, 3)`` m², the covariance of where the steps end; 0 of a single step.
        by_bias: ``(M, 3, 3)`` rad per rad a step, how far a bias turned the newer end.
        shift_by_bias: ``(M, 3, 3)`` metres per rad a step, how far it moved it; 0 of a single step.
    """

    turned: Array
    way: Array
    lag: Array
    spread: Array
    by_bias: Array
    shift_by_bias: Array

    @classmethod
    def even(cls, turn: Array, displacement: Array, steps: Array) -> Routes:
        """Of edges whose steps are all alike and turn little, as those of a single step do.

        Args:
            turn: ``(M,)`` rad.
            displacement: ``(M, 3)`` metres, by the older end's axes.
            steps: ``(M,)`` how many they stand for.
        """
        outer = displacement[:, :, None] * displacement[:, None, :]
        lag = displacement * ((steps - 1) / (2 * steps))[:, None]
        return cls(
            turn**2 / steps,
            np.linalg.norm(displacement, axis=1),
            lag,
            outer * np.maximum((steps**2 - 1) / (12 * steps**2), 0.0)[:, None, None],
            steps[:, None, None] * np.eye(3),
            -steps[:, None, None] * _cross(lag),
        )

    @classmethod
    def known(cls, columns: Array, otherwise: Routes) -> Routes:
        """As :attr:`columns` ``(M, 29)`` have them, NaN where unknown: there as others."""
        spread = np.empty((len(columns), 3, 3))
        spread[:, _SYMMETRIC[0], _SYMMETRIC[1]] = spread[:, _SYMMETRIC[1], _SYMMETRIC[0]] = columns[:, 5:11]
        by_bias, shift_by_bias = (columns[:, part].reshape(-1, 3, 3) for part in (slice(11, 20), slice(20, 29)))
        stated = (columns[:, 0], columns[:, 1], columns[:, 2:5], spread, by_bias, shift_by_bias)
        given = (getattr(otherwise, each.name) for each in fields(otherwise))
        return cls(*(np.where(np.isnan(own), other, own) for own, other in zip(stated, given, strict=True)))

    @property
    def columns(self) -> Array:
        """``(M, 29)``."""
        triangle = self.spread[:, _SYMMETRIC[0], _SYMMETRIC[1]]
        of_bias = self.by_bias.reshape(-1, 9), self.shift_by_bias.reshape(-1, 9)
        return np.column_stack((self.turned, self.way, self.lag, triangle, *of_bias))


def joined(parts: Sequence[Routes], steps: Sequence[Array], displacement: Sequence[Array], turn: Array) -> Routes:
    """Of edges of which each goes on where another one ends.

    Args:
        parts: of the first and the second.
        steps: ``(M,)`` of each.
        displacement: ``(M, 3)`` metres of each, by its own older end's axes.
        turn: ``(M, 3, 3)`` from the second's axes to the first's.
    """
    (first, second), (before, after) = parts, displacement
    share = steps[0] / (steps[0] + steps[1])
    lag, after = (np.einsum("mij,mj->mi", turn, vector) for vector in (second.lag, after))
    apart = before - first.lag - (before + after - lag)
    one, other = share[:, None], 1 - share[:, None]
    outer = apart[:, :, None] * apart[:, None, :]
    spread = one[:, :, None] * first.spread + other[:, :, None] * (turn @ second.spread @ np.swapaxes(turn, 1, 2))
    return Routes(
        first.turned + second.turned,
        first.way + second.way,
        one * (first.lag + after) + other * lag,
        spread + (one * other)[:, :, None] * outer,
        first.by_bias + turn @ second.by_bias,
        first.shift_by_bias - _cross(after) @ first.by_bias + turn @ second.shift_by_bias,
    )


def _cross(vector: Array) -> Array:
    """``(M, 3, 3)``: what takes w to v × w."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1).reshape(-1, 3, 3)
