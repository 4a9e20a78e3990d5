"""What odometry did between the ends of an edge into which several of its steps were merged.

Keyframes that no closure touches are marginalised: an edge then states where all of its steps together lead, and by
``steps`` how many there were. The path matters as well: where odometry errs in turns, the variance follows the squares
of all turns, not the square of their sum; and a step's translation rotates with every correction before it. So an edge
keeps sums over its steps. In the older end's axes, let d_i be the i-th step's displacement, P_i = d_1 + … + d_i its
end, and g_i the share of the variance before it, either with equal variances of all steps or in proportion to the
squares of their turns,

    lag = Σ g_i d_i ,    spread = the covariance of all P_i, whose mean is  D − lag ,  D = P_n .

and, with W_i the rotation from the axes where step i begins to the older end's, J_i = W_1 + … + W_{i-1},

    by_bias = Σ W_i ,    shift_by_bias = Σ [J_i ·] × d_i ,

which say how a bias of the gyroscope turned and moved it. To first order, this is all that ``solver/slam`` needs of an
edge's steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SYMMETRIC = np.triu_indices(3)
#: Numbers of an edge: turned, way, by steps and by turns a lag (3) and the upper triangle of its spread (6), by_bias
#: (9), shift_by_bias (9).
ROUTE_COLUMNS = 38

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Bend:
    """How M edges bend and widen when their turns are wrong, for one distribution of the variance along them.

    Attributes:
        lag: ``(M, 3)`` metres, Σ g_i d_i; 0 for a single step, which is measured where it begins.
        spread: ``(M, 3, 3)`` m², the covariance of the steps' ends; 0 for a single step.
    """

    lag: Array
    spread: Array

    def mixed(self, other: Bend, share: Array) -> Bend:
        """The mixture in which the share ``(M,)`` of the variance is distributed as in ``other``."""
        one, rest = share[:, None], 1 - share[:, None]
        spread = rest[:, :, None] * self.spread + one[:, :, None] * other.spread
        return Bend(
            rest * self.lag + one * other.lag, spread + (one * rest)[:, :, None] * _square(self.lag - other.lag)
        )


@dataclass(frozen=True)
class Routes:
    """Routes of M odometry edges, in the axes of their older ends.

    Attributes:
        turned: ``(M,)`` rad², the sum of the squares of the steps' turns.
        way: ``(M,)`` metres, the sum of the steps' lengths.
        by_steps: bend for equal variances of all steps.
        by_turns: bend for variances in proportion to the squares of their turns.
        by_bias: ``(M, 3, 3)`` rad per rad a step, how far a bias turned the newer end.
        shift_by_bias: ``(M, 3, 3)`` metres per rad a step, how far a bias moved the newer end; 0 for a single step.
    """

    turned: Array
    way: Array
    by_steps: Bend
    by_turns: Bend
    by_bias: Array
    shift_by_bias: Array

    @classmethod
    def even(cls, turn: Array, displacement: Array, steps: Array) -> Routes:
        """Routes of edges whose steps are all alike and turn little, as for single steps.

        Args:
            turn: ``(M,)`` rad.
            displacement: ``(M, 3)`` metres, in the older end's axes.
            steps: ``(M,)`` number of steps that each stands for.
        """
        lag = displacement * ((steps - 1) / (2 * steps))[:, None]
        share = np.maximum((steps**2 - 1) / (12 * steps**2), 0.0)
        bend = Bend(lag, share[:, None, None] * _square(displacement))
        by_bias = steps[:, None, None] * np.eye(3)
        shift = -steps[:, None, None] * _cross(lag)
        return cls(turn**2 / steps, np.linalg.norm(displacement, axis=1), bend, bend, by_bias, shift)

    @classmethod
    def known(cls, columns: Array, otherwise: Routes) -> Routes:
        """Routes from :attr:`columns` ``(M, 38)``; where these are NaN (unknown), from ``otherwise``."""
        values = np.where(np.isnan(columns), otherwise.columns, columns)
        by_steps, by_turns = (_bend_of(values[:, part]) for part in (slice(2, 11), slice(11, 20)))
        by_bias, shift_by_bias = (values[:, part].reshape(-1, 3, 3) for part in (slice(20, 29), slice(29, 38)))
        return cls(values[:, 0], values[:, 1], by_steps, by_turns, by_bias, shift_by_bias)

    def bent(self, by_turns: Array) -> Bend:
        """The bend if the share ``(M,)`` of the variance is in proportion to the squares of turns."""
        return self.by_steps.mixed(self.by_turns, by_turns)

    @property
    def columns(self) -> Array:
        """``(M, 38)``."""
        bends = [
            column
            for bend in (self.by_steps, self.by_turns)
            for column in (bend.lag, bend.spread[:, _SYMMETRIC[0], _SYMMETRIC[1]])
        ]
        of_bias = self.by_bias.reshape(-1, 9), self.shift_by_bias.reshape(-1, 9)
        return np.column_stack((self.turned, self.way, *bends, *of_bias))


def joined(parts: Sequence[Routes], steps: Sequence[Array], displacement: Array, turn: Array) -> Routes:
    """Routes of edges joined from two, of which the second begins where the first ends.

    Args:
        parts: routes of the first and the second.
        steps: ``(M,)`` number of steps of each.
        displacement: ``(M, 3)`` metres, of the second, in the axes of its own older end.
        turn: ``(M, 3, 3)`` rotation from the second's axes to the first's.
    """
    first, second = parts
    after = _turned(turn, displacement)

    def bend(one: Bend, other: Bend, share: Array) -> Bend:
        """The joined bend, where the share ``(M,)`` of the variance is the first's."""
        lag = _turned(turn, other.lag)
        spread = turn @ other.spread @ np.swapaxes(turn, 1, 2)
        # Both in the axes of the first's older end, with the effect of the first's variance on what comes after it.
        return Bend(one.lag + after, one.spread).mixed(Bend(lag, spread), 1 - share)

    by_number = steps[0] / (steps[0] + steps[1])
    turned = first.turned + second.turned
    by_square = np.divide(first.turned, turned, out=by_number.copy(), where=turned > 0)
    return Routes(
        turned,
        first.way + second.way,
        bend(first.by_steps, second.by_steps, by_number),
        bend(first.by_turns, second.by_turns, by_square),
        first.by_bias + turn @ second.by_bias,
        first.shift_by_bias - _cross(after) @ first.by_bias + turn @ second.shift_by_bias,
    )


def _bend_of(columns: Array) -> Bend:
    """The bend stored in columns ``(M, 9)``."""
    spread = np.empty((len(columns), 3, 3))
    spread[:, _SYMMETRIC[0], _SYMMETRIC[1]] = spread[:, _SYMMETRIC[1], _SYMMETRIC[0]] = columns[:, 3:]
    return Bend(columns[:, :3], spread)


def _turned(turn: Array, vector: Array) -> Array:
    return np.asarray(np.einsum("mij,mj->mi", turn, vector))


def _square(vector: Array) -> Array:
    return np.asarray(vector[:, :, None] * vector[:, None, :])


def _cross(vector: Array) -> Array:
    """``(M, 3, 3)``: the matrices that map w to v × w."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack((zero, -z, y, z, zero, -x, -y, x, zero), axis=1).reshape(-1, 3, 3)
