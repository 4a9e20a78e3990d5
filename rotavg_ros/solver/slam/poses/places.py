"""How a closure's translation errs: well, in tails, or because it joins wrong places; and whether its rotation does.

All of these are one mixture of normal densities of one error ε. What everything else says of a closure's residual,
N(μ, P) in k turns and m shifts together, gives each class its chance, and the weight with which the closure pulls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.poses.closures import (
    GOOD,
    Places,
    Predictions,
    Scale,
    Told,
    along_axes,
    given_turn,
    log_from_behind,
)
from rotavg_ros.solver.slam.poses.priors import PlacePriors
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.repeats.neighbours import Errors, Repeats, repeats_of, wrong_share

# Classes of wrong places of their own; one more repeats another's.
_WRONG = 6
_ELSEWHERE = _WRONG + 1
# Nobody calls a place alike that is seen turned by more standard deviations than this.
_FARTHEST = 3.0
# What pulls least, of a good closure's weight: nothing, but the system stays solvable.
_NOTHING = 1e-8
_LOG_NOTHING = -1e6


@dataclass(frozen=True)
class Judge:
    """Tells the classes of all closures by what all else says of them.

    Attributes:
        told: what rotations alone say.
        turns: k.
        priors: of places.
        held: ``(C,)`` bool, which rotations are good; None: by their densities.
    """

    told: Told
    turns: int
    priors: PlacePriors
    held: np.ndarray | None = None

    def __call__(
        self, predictions: Predictions, maps: MapTurns, before: np.ndarray, scale: Scale, *, in_order: bool = False
    ) -> Places:
        """Classes under one choice of noise.

        Args:
            predictions: what all else says.
            maps: by what turns of the map closures are off from that.
            before: ``(J + 1, C)`` chances as they were, for how common wrong places are.
            scale: of errors.
            in_order: given the closures before alone, so that densities multiply to that of all; else given all others.
        """
        k, told, known = self.turns, self.told, self.told.is_known
        seen_alike = told.rotation_variance + np.radians(self.priors.turned_deg) ** 2
        here = given_turn(predictions, told.rotation_variance, k)
        elsewhere = given_turn(predictions, seen_alike, k)
        spread = np.stack([here.spread] * GOOD + [elsewhere.spread] * _ELSEWHERE)
        along = np.stack([here.along] * GOOD + [elsewhere.along] * _ELSEWHERE)
        log_turn = np.stack([here.log_turn] * GOOD + [elsewhere.log_turn] * _ELSEWHERE)
        variance = self._variances(scale)
        total = spread + variance[:, :, None]
        log_shift = -(along**2 / total + np.log(2 * np.pi * total)).sum(axis=2) / 2
        rest()
        turn, shift = np.split(told.sign[:, None] * predictions.mean, [k], axis=1)
        errors = Errors(turn, shift, told.rotation_variance, scale.closure, predictions.tell(k, scale.extent))
        repeats = repeats_of(errors, before, told, in_order=in_order)
        # Turn and shift are those of the one that is repeated, which is seen nearly at the right angle.
        log_turn[-1], log_shift[-1] = -np.maximum(elsewhere.square - _FARTHEST**2, 0.0) / 2, 0.0
        share = wrong_share(before, told, self.priors)
        shifts = along_axes(predictions, k)
        by_itself = log_wrong, log_right = self._by_itself(shifts, scale)
        wrong = before[-1] * expit(log_wrong - log_right)
        rest()
        turned = maps.repeats(wrong, np.logaddexp(log_wrong, log_right), told, in_order=in_order)
        log_false = told.false_odds + np.where(known, self._log_unrelated(by_itself, repeats, turned), 0.0)
        log_behind = log_from_behind(predictions, seen_alike, k) + self._log_behind(shifts, scale, repeats)
        log_false = np.where(known, np.logaddexp(log_false, log_behind + np.log(share)), log_false)
        log_class = log_shift + self._log_classes(share, repeats)
        # Without a translation nothing tells of a place: a closure whose rotation is right is good.
        log_class[:, ~known] = _LOG_NOTHING
        log_class[0, ~known] = 0.0
        log_all = self._as_labelled(np.concatenate((log_turn + log_class, log_false[None])))
        log_density = _log_sum(log_all)
        chance = np.exp(log_all - log_density)

        each = chance[:-1, :, None]
        pull = (each / total).mean(axis=2).sum(axis=0)
        shrunk = (each * variance[:, :, None] / total).mean(axis=2).sum(axis=0) + chance[-1]
        right, alike = chance[:GOOD].sum(axis=0), chance[GOOD:-1].sum(axis=0)
        p = np.trace(predictions.covariance[:, :k, :k], axis1=1, axis2=2) / k
        turn_pull = right / (told.rotation_variance + p) + alike / (seen_alike + p)
        turn_shrunk = right / (1 + p / told.rotation_variance) + alike / (1 + p / seen_alike) + chance[-1]
        square, turn_total = (predictions.mean[:, :k] ** 2).sum(axis=1), told.rotation_variance + p
        turn_squares = right * square * told.rotation_variance / turn_total**2
        turn_freedom = right * k * told.rotation_variance / turn_total
        good, at_good = slice(GOOD), each[:GOOD] * known[:, None]
        own = variance[good, :, None] * np.stack((scale.floor_share, 1 - scale.floor_share))[:, None, :, None]
        axes = (1, 2, 3)
        return Places(
            chance,
            np.maximum(np.where(known, pull / shrunk, 0.0), _least_weight((shift**2).sum(axis=1), scale)),
            np.maximum(turn_pull / turn_shrunk, _NOTHING / told.rotation_variance),
            np.append(turn_squares.sum(), (at_good * own * along[good] ** 2 / total[good] ** 2).sum(axis=axes)),
            np.append(turn_freedom.sum(), (at_good * own / total[good]).sum(axis=axes)),
            log_density,
            *self._errors(shifts, scale, (along, spread, variance)),
        )

    def _errors(
        self, shifts: tuple[np.ndarray, np.ndarray], scale: Scale, classes: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(J + 1, C)`` metres and m² per component: length of ε's mean, and its variance.

        Args:
            shifts: what all else says of them along axes, ``(C, m)`` means and variances.
            scale: of errors.
            classes: ``(J, C, m)`` means and variances of what is said along axes, ``(J, C)`` variances of ε. A false
                rotation may be anywhere, whatever its turn says.
        """
        along, spread = (
            np.concatenate((of_classes, anywhere[None]))
            for of_classes, anywhere in zip(classes[:2], shifts, strict=True)
        )
        variance = np.concatenate((classes[2], np.full((1, along.shape[1]), scale.extent)))[:, :, None]
        total = spread + variance
        return np.sqrt(((variance * along / total) ** 2).sum(axis=2)), (variance * spread / total).mean(axis=2)

    def nothing_known(self, is_good: np.ndarray, square: np.ndarray, scale: Scale) -> Places:
        """Before any solve: no translation pulls, rotations do as labelled, and as many places are wrong as may be.

        Args:
            is_good: ``(C,)`` labels.
            square: ``(C,)`` m², by what translations are off.
            scale: of errors.
        """
        count = len(is_good)
        chance = np.zeros((GOOD + _ELSEWHERE + 1, count))
        wrong = self.priors.wrong_place / self.priors.counted
        chance[0], chance[GOOD], chance[-1] = is_good * (1 - wrong), is_good * wrong, ~is_good
        none = np.zeros((GOOD + _ELSEWHERE + 1, count))
        turn = np.where(is_good, 1.0, _NOTHING) / self.told.rotation_variance
        return Places(
            chance,
            _least_weight(square, scale),
            turn,
            np.zeros(3),
            np.zeros(3),
            np.zeros(count),
            none,
            none,
        )

    def _variances(self, scale: Scale) -> np.ndarray:
        """``(J, C)`` m² per component, of ε in each class."""
        good = scale.own * np.array([[1.0], [self.priors.tail_ratio]])
        wrong = np.append(self._wrong(scale), scale.extent)
        return np.concatenate((good, np.broadcast_to(wrong[:, None], (_ELSEWHERE, good.shape[1]))))

    def _wrong(self, scale: Scale) -> np.ndarray:
        """m², from the least that a wrong place is off by to the map's extent."""
        least = min(self.priors.least_wrong**2 * scale.closure, scale.extent)
        return np.asarray(scale.extent * (least / scale.extent) ** np.linspace(1.0, 0.0, _WRONG))

    def _log_classes(self, share: np.ndarray, repeats: Repeats) -> np.ndarray:
        """``(J, C)`` nats, of each class if the rotation is no false one.

        Args:
            share: ``(C,)`` of wrong places.
            repeats: of those before and after.
        """
        priors = self.priors
        right, wrong = np.log1p(-share), np.log(share)
        log_alone, log_repeat = self._log_repeats(repeats.alike, repeats)
        with np.errstate(divide="ignore"):
            log_elsewhere = np.maximum(np.log(priors.elsewhere * repeats.elsewhere), _LOG_NOTHING)
        log_repeat = np.logaddexp(log_repeat, log_alone + log_elsewhere)
        log_alone = log_alone + np.log1p(-priors.elsewhere * repeats.has_elsewhere)
        by_itself = wrong + log_alone + np.log1p(-priors.from_behind) - np.log(_WRONG)
        return np.stack(
            (
                right + np.log1p(-priors.tails),
                right + np.log(priors.tails),
                *[by_itself] * _WRONG,
                wrong + log_repeat,
            )
        )

    def _log_repeats(self, density: np.ndarray, repeats: Repeats) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` nats each: that a wrong place is no neighbour's; and that it is, with the density given by it."""
        share = self.priors.repeats
        with np.errstate(divide="ignore"):
            return np.log1p(-share * repeats.chance), np.maximum(np.log(share * density), _LOG_NOTHING)

    @staticmethod
    def _log_anywhere(shifts: tuple[np.ndarray, np.ndarray], scale: Scale) -> np.ndarray:
        """``(C,)`` nats, of shifts that lead anywhere on the map."""
        along, spread = shifts
        total = spread + scale.extent
        return np.asarray(-(along**2 / total + np.log(2 * np.pi * total)).sum(axis=1) / 2)

    def _log_behind(self, shifts: tuple[np.ndarray, np.ndarray], scale: Scale, repeats: Repeats) -> np.ndarray:
        """``(C,)`` nats, of shifts of closures that join wrong places, seen from the other side."""
        log_alone, log_repeat = self._log_repeats(repeats.turned, repeats)
        log_alone = log_alone + np.log(self.priors.from_behind) + self._log_anywhere(shifts, scale)
        return np.asarray(np.logaddexp(log_alone, log_repeat))

    def _by_itself(self, shifts: tuple[np.ndarray, np.ndarray], scale: Scale) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` nats each, of shifts of closures whose rotation is false: at wrong places, and at the right one."""
        along, spread = shifts
        right = spread + scale.own[:, None]
        log_right = -(along**2 / right + np.log(2 * np.pi * right)).sum(axis=1) / 2
        share = self.priors.turned_in_place
        return self._log_anywhere(shifts, scale) + np.log1p(-share), log_right + np.log(share)

    def _log_unrelated(
        self, by_itself: tuple[np.ndarray, np.ndarray], repeats: Repeats, elsewhere: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """``(C,)`` nats, of shifts of closures whose rotation is false: wrong places, or the right one turned.

        Args:
            by_itself: nats of shifts at wrong places and at the right one, if no other has to do with them.
            repeats: of those before and after.
            elsewhere: of those anywhere, by the same turn of the map.
        """
        log_alone, log_repeat = self._log_repeats(repeats.turned, repeats)
        log_by_itself = np.logaddexp(*by_itself)
        chance, density = elsewhere
        share = self.priors.elsewhere
        with np.errstate(divide="ignore"):
            log_elsewhere = np.maximum(np.log(share * density), _LOG_NOTHING)
        log_alone = log_alone + np.logaddexp(log_by_itself + np.log1p(-share * chance), log_elsewhere)
        return np.asarray(np.logaddexp(log_alone, log_repeat))

    def _as_labelled(self, log_all: np.ndarray) -> np.ndarray:
        """Without the classes that somebody's label, or that of rotations, rules out."""
        accepted = self.told.label > 0
        is_good = accepted if self.held is None else self.held
        is_false = self.told.label < 0 if self.held is None else ~self.held
        log_all[-1, is_good] = _LOG_NOTHING
        log_all[:-1, is_false] = _LOG_NOTHING
        log_all[GOOD:, accepted & self.told.is_known] = _LOG_NOTHING
        return log_all


def _log_sum(logarithms: np.ndarray) -> np.ndarray:
    """``(n,)`` log of sums over the first axis, of numbers that are finite."""
    largest = logarithms.max(axis=0)
    return np.asarray(largest + np.log(np.exp(logarithms - largest).sum(axis=0)))


def _least_weight(square: np.ndarray, scale: Scale) -> np.ndarray:
    """``(C,)`` m⁻², of closures that are off by ``square`` m²: however far that is, they pull next to nothing."""
    return np.asarray(_NOTHING / (scale.closure + square))
