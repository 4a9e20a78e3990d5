"""The sums over pairs of closures behind :meth:`~rotavg_ros.solver.slam.poses.repeats.map_turns.MapTurns.repeats`.

Each closure's turn of the map predicts the turn and shift of another one. If the two are turned alike, the variance of
the difference from this prediction is known, including the lever arm of the turn. The density of the difference is
normal for turns, and of a few widths for shifts, given the turn.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.slam.noise.repeats import Near
from rotavg_ros.solver.slam.poses.repeats.exactness import mean

# The variance of a difference is known only roughly, so there are several: each this many times the one before.
_BROADER = 16.0
# Number of variances for closures anywhere, and for those that follow each other.
WIDTHS, WIDTHS_AFTER = 2, 3
# Largest volume of a density that tells anything, as a share of that of shifts to anywhere. It is the share of random
# closures that meet it by chance.
_COVERS = 0.1
# Turns are alike up to this many standard deviations.
_FARTHEST = 4.0
# Probabilities of being the same turn that are smaller than this are neglected.
_NEGLIGIBLE = 1e-8
# Lower bounds of a squared sine, and of a density.
_TINY, _LEAST = 1e-30, 1e-300


# Columns in a closure's row where its shift, its place and its covariance begin, after its turn.
_SHIFT, _PLACE, _COVARIANCE = 4, 7, 10


class Axes(NamedTuple):
    """``(3, k)`` of turns and ``(3, m)`` of shifts."""

    turns: np.ndarray
    shifts: np.ndarray


def closure_rows(turn: np.ndarray, shift: np.ndarray, place: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """``(C, 10 + d²)`` one row per closure, so that what is read together is contiguous.

    Args:
        turn: ``(4, C)`` unit quaternions.
        shift, place: ``(C, 3)`` metres.
        covariance: ``(C, d, d)`` of turns and shifts.
    """
    entries = covariance.shape[1] * covariance.shape[2]
    return np.concatenate((turn.T, shift, place, covariance.reshape(len(shift), entries)), axis=1)


@compiled
def repeated_density(
    turned: np.ndarray, axes: Axes, chance: np.ndarray, log_alone: np.ndarray, among: Near, of_all: Near
) -> tuple[np.ndarray, np.ndarray]:
    """``(C,)`` expected number of others that are turned alike, at most 1; ``(C, W)`` densities of each shift by these.

    Each of the others is represented by the mean of all that seem to be off by the same turn, weighted by precision.

    Args:
        turned: the closures as :func:`closure_rows`.
        axes: of turns and shifts.
        chance: ``(C,)`` probability that each joins wrong places that are turned.
        log_alone: ``(C,)`` nats, log density of its shift without any relation to another closure.
        among: the closures that are evidence, compared with each other.
        of_all: the closures that are asked for, compared with these.
    """
    count, k = len(chance), axes.turns.shape[1]
    size = k + axes.shifts.shape[1]
    tells, near, nearby = among.rows, among.between, of_all.between
    most = 1
    for t in range(len(tells)):
        most = max(most, 1 + near[t, 1] - near[t, 0] + near[t, 3] - near[t, 2])
    # For each closure that is evidence: which are off by the same turn, and with which probability.
    number = np.empty(len(tells), np.int64)
    alike, how = np.empty((len(tells), most), np.int64), np.empty((len(tells), most))
    difference, root, same = np.empty(size), np.empty((size + 1, size)), np.empty(WIDTHS)
    spread, lever = np.empty((size - k, size - k)), np.empty((size - k, k))
    predicted = difference, spread, lever
    variance_of_turn = np.zeros(count)
    for d in range(k):
        variance_of_turn += turned[:, _COVARIANCE + d * size + d]
    for t in range(len(tells)):
        row = tells[t]
        alike[t, 0], how[t, 0], number[t] = row, chance[row], 1
        for side in range(2):
            for place in range(near[t, 2 * side], near[t, 2 * side + 1]):
                other = tells[place]
                if _differ_by_far(turned, variance_of_turn, row, other):
                    continue
                of_turn, of_shift = _difference(turned, axes, row, other, predicted)
                if of_turn < 0:
                    continue
                _fill_evenly(spread, of_shift)
                _, squares, volume = _whitened(turned, row, difference, (of_turn, spread), root)
                _fill(same, squares, volume, size - k)
                repeated = mean(same)
                likely = repeated / max(repeated + math.exp(log_alone[row]), _LEAST)
                if likely > _NEGLIGIBLE:
                    alike[t, number[t]], how[t, number[t]] = other, likely * chance[other]
                    number[t] += 1
    surely, density = np.zeros(count), np.zeros((count, WIDTHS))
    most = 1
    for n in range(len(of_all.rows)):
        most = max(most, nearby[n, 1] - nearby[n, 0] + nearby[n, 3] - nearby[n, 2])
    listed, apart, variance = np.empty(most, np.int64), np.empty((most, size)), np.empty((most, 2))
    slot = np.full(count, -1, np.int64)
    for asked in range(len(of_all.rows)):
        c, found = of_all.rows[asked], 0
        for side in range(2):
            for place in range(nearby[asked, 2 * side], nearby[asked, 2 * side + 1]):
                if _differ_by_far(turned, variance_of_turn, c, tells[place]):
                    continue
                of_turn, of_shift = _difference(turned, axes, c, tells[place], predicted)
                if of_turn >= 0:
                    listed[found], slot[tells[place]] = place, found
                    for d in range(size):
                        apart[found, d] = difference[d]
                    variance[found, 0], variance[found, 1] = of_turn, of_shift
                    found += 1
        for n in range(found):
            # The mean over all that are turned like this one.
            t = listed[n]
            total, of_turn = 0.0, 0.0
            for d in range(size):
                difference[d] = 0.0
            for entry in range(number[t]):
                at = slot[alike[t, entry]]
                if at >= 0:
                    weight = how[t, entry] / variance[at, 1]
                    total += weight
                    of_turn += weight / variance[at, 1] * variance[at, 0]
                    for d in range(size):
                        difference[d] += weight * apart[at, d]
            for d in range(size):
                difference[d] /= total
            _fill_evenly(spread, 1 / total)
            square, squares, volume = _whitened(turned, c, difference, (of_turn / total**2, spread), root)
            _fill(same, squares, volume, size - k)
            _tell_nothing_if_broad(same, volume, size - k, math.exp(log_alone[c]))
            weight = chance[tells[t]] * math.exp(-square / 2)
            surely[c] += weight
            for width in range(WIDTHS):
                density[c, width] += weight * same[width]
        for n in range(found):
            slot[tells[listed[n]]] = -1
        for width in range(WIDTHS):
            density[c, width] /= max(surely[c], 1.0)
        surely[c] = min(surely[c], 1.0)
    return surely, density


@compiled
def repeated_after(turned: np.ndarray, axes: Axes, later: np.ndarray, earlier: np.ndarray) -> np.ndarray:
    """``(2, P, W)`` densities of shifts: of the later closure by the turn of the earlier one, and vice versa.

    Args:
        turned: closures as :func:`closure_rows`, with the part of the covariance that neighbours do not share.
        axes: of turns and shifts.
        later, earlier: ``(P,)`` closures.
    """
    k = axes.turns.shape[1]
    size = k + axes.shifts.shape[1]
    density = np.zeros((2, len(later), WIDTHS_AFTER))
    difference, root = np.empty(size), np.empty((size + 1, size))
    spread, lever = np.empty((size - k, size - k)), np.empty((size - k, k))
    for pair in range(len(later)):
        for end in range(2):
            row, other = (later[pair], earlier[pair]) if end == 0 else (earlier[pair], later[pair])
            of_turn, _ = _difference(turned, axes, row, other, (difference, spread, lever))
            if of_turn >= 0:
                _, squares, volume = _whitened(turned, row, difference, (of_turn, spread), root)
                _fill(density[end, pair], squares, volume, size - k)
    return density


@compiled
def _differ_by_far(turned: np.ndarray, variance: np.ndarray, row: int, other: int) -> bool:
    """Whether two closures are clearly not turned alike, without a sine: cos a ≥ 1 − a²/2.

    Most pairs are not. :func:`_difference` takes so many arrays that calling it costs thirty times as much.

    Args:
        turned: closures.
        variance: ``(C,)`` rad², of their turns, summed over components.
        row, other: the two closures.
    """
    w = turned[row, 3] * turned[other, 3] + turned[row, 0] * turned[other, 0]
    w += turned[row, 1] * turned[other, 1] + turned[row, 2] * turned[other, 2]
    return bool(abs(w) < 1 - _FARTHEST**2 * (variance[row] + variance[other]) / 8)


@compiled
def _difference(
    turned: np.ndarray, axes: Axes, row: int, other: int, predicted: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[float, float]:
    """Compute the difference between one closure and what the turn of another predicts for it.

    Args:
        turned: closures.
        axes: of turns and shifts.
        row, other: the two closures.
        predicted: to be filled: the difference ``(k + m,)``, rad and metres; lower half ``(m, m)`` of the covariance of
            the predicted shift, m²; and ``(m, k)`` metres a radian by which turns of the other one move it.

    Returns:
        Variances per component of the prediction, rad² and m²; negative if their turns are not the same.
    """
    turns, shifts = axes
    difference, spread, lever = predicted
    k, m = turns.shape[1], shifts.shape[1]
    size = k + m
    own, of_turn = 0.0, 0.0
    for d in range(k):
        own += turned[row, _COVARIANCE + d * size + d]
        of_turn += turned[other, _COVARIANCE + d * size + d]
    # a ∘ b⁻¹ as a rotation vector.
    a0, a1, a2, a3 = turned[row, 0], turned[row, 1], turned[row, 2], turned[row, 3]
    b0, b1, b2, b3 = turned[other, 0], turned[other, 1], turned[other, 2], turned[other, 3]
    w = a3 * b3 + a0 * b0 + a1 * b1 + a2 * b2
    x = -a3 * b0 + a0 * b3 - a1 * b2 + a2 * b1
    y = -a3 * b1 + a1 * b3 - a2 * b0 + a0 * b2
    z = -a3 * b2 + a2 * b3 - a0 * b1 + a1 * b0
    sine = math.sqrt(max(x * x + y * y + z * z, _TINY))
    angle = 2 * math.atan2(sine, abs(w))
    if not angle**2 < _FARTHEST**2 * (own + of_turn):
        return -1.0, -1.0
    scale = angle / sine * (1.0 if w >= 0 else -1.0)
    for d in range(k):
        difference[d] = scale * (x * turns[0, d] + y * turns[1, d] + z * turns[2, d])
    # The vector from the other's place to this one's, turned by the other's turn.
    arm0 = turned[row, _PLACE] - turned[other, _PLACE]
    arm1 = turned[row, _PLACE + 1] - turned[other, _PLACE + 1]
    arm2 = turned[row, _PLACE + 2] - turned[other, _PLACE + 2]
    c0, c1, c2 = b1 * arm2 - b2 * arm1, b2 * arm0 - b0 * arm2, b0 * arm1 - b1 * arm0
    t0 = arm0 + 2 * (b3 * c0 + b1 * c2 - b2 * c1)
    t1 = arm1 + 2 * (b3 * c1 + b2 * c0 - b0 * c2)
    t2 = arm2 + 2 * (b3 * c2 + b0 * c1 - b1 * c0)
    off0 = turned[row, _SHIFT] - turned[other, _SHIFT] - t0 + arm0
    off1 = turned[row, _SHIFT + 1] - turned[other, _SHIFT + 1] - t1 + arm1
    off2 = turned[row, _SHIFT + 2] - turned[other, _SHIFT + 2] - t2 + arm2
    # The lever arms: sᵀ (t ×) = (s × t)ᵀ.
    for e in range(m):
        s0, s1, s2 = shifts[0, e], shifts[1, e], shifts[2, e]
        difference[k + e] = off0 * s0 + off1 * s1 + off2 * s2
        l0, l1, l2 = s1 * t2 - s2 * t1, s2 * t0 - s0 * t2, s0 * t1 - s1 * t0
        for d in range(k):
            lever[e, d] = l0 * turns[0, d] + l1 * turns[1, d] + l2 * turns[2, d]
    of_shift = 0.0
    for e in range(m):
        for g in range(e + 1):
            entry = turned[other, _COVARIANCE + (k + e) * size + k + g]
            for d in range(k):
                entry -= lever[e, d] * turned[other, _COVARIANCE + d * size + k + g]
                entry -= lever[g, d] * turned[other, _COVARIANCE + d * size + k + e]
                for f in range(k):
                    entry += lever[e, d] * lever[g, f] * turned[other, _COVARIANCE + d * size + f]
            spread[e, g] = entry
        of_shift += spread[e, e]
    return of_turn / k, of_shift / m


@compiled
def _whitened(
    turned: np.ndarray, row: int, difference: np.ndarray, said: tuple[float, np.ndarray], root: np.ndarray
) -> tuple[float, float, float]:
    """The squared differences of turns, and of shifts given turns, in standard deviations; and the latter's volume.

    That is the inverse of the height of the normal density of shifts.

    Args:
        turned, row: one of the closures.
        difference: ``(k + m,)`` from the other's prediction.
        said: variance of that prediction's turn, rad² per component, and lower half ``(m, m)`` of its shift's
            covariance, m².
        root: ``(k + m + 1, k + m)`` room for Cholesky's factor, and for the whitened difference.
    """
    of_turn, spread = said
    size = len(difference)
    k = size - len(spread)
    square, squares, volume = 0.0, 0.0, (2 * math.pi) ** (len(spread) / 2)
    for i in range(size):
        value = difference[i]
        for j in range(i):
            entry = turned[row, _COVARIANCE + i * size + j]
            if j >= k:
                entry += spread[i - k, j - k]
            for n in range(j):
                entry -= root[i, n] * root[j, n]
            root[i, j] = entry / root[j, j]
            value -= root[i, j] * root[size, j]
        pivot = turned[row, _COVARIANCE + i * size + i] + (of_turn if i < k else spread[i - k, i - k])
        for n in range(i):
            pivot -= root[i, n] * root[i, n]
        root[i, i] = math.sqrt(pivot)
        root[size, i] = value / root[i, i]
        if i < k:
            square += root[size, i] * root[size, i]
        else:
            squares += root[size, i] * root[size, i]
            volume *= root[i, i]
    return square, squares, volume


@compiled
def _fill_evenly(spread: np.ndarray, variance: float) -> None:
    """Fill a covariance ``(m, m)``: the same along all axes."""
    spread[:] = 0.0
    for e in range(len(spread)):
        spread[e, e] = variance


@compiled
def _fill(same: np.ndarray, squares: float, volume: float, components: int) -> None:
    """Fill ``(W,)`` densities of a difference of shifts, the narrowest first.

    Args:
        same: to be filled.
        squares: squared difference, in standard deviations of the narrowest.
        volume: inverse of that one's height.
        components: m.
    """
    for width in range(len(same)):
        same[width] = math.exp(-squares / 2) / volume
        squares /= _BROADER
        volume *= _BROADER ** (components / 2)


@compiled
def _tell_nothing_if_broad(same: np.ndarray, volume: float, components: int, alone: float) -> None:
    """Set densities ``(W,)`` that cover much of the map to the density without any relation.

    That one is the geometric mean of a normal density over its own values. Random closures, each under the likelier of
    it and a kernel nearly as broad, would seem to repeat others.

    Args:
        same: to be changed, the narrowest first.
        volume: inverse of the narrowest's height.
        components: m.
        alone: the density without any relation.
    """
    for width in range(len(same)):
        if volume * alone * math.exp(components / 2) > _COVERS:
            same[width] = alone
        volume *= _BROADER ** (components / 2)
