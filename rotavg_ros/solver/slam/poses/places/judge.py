"""Judges closures: normal noise, tails or wrong places in translation, and false rotations.

All of these form one mixture of normal densities of one error ε (:mod:`rotavg_ros.solver.slam.poses.places.classes`).
Everything else predicts a closure's residual as N(μ, P), in k turns and m shifts together. This gives the probability
of each class, and the closure's weight (:mod:`rotavg_ros.solver.slam.poses.places.pulls`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.poses.closures import (
    GOOD,
    REPEATS,
    TAILS,
    Places,
    Predictions,
    Scale,
    Told,
    log_from_behind,
)
from rotavg_ros.solver.slam.poses.places import pulls
from rotavg_ros.solver.slam.poses.places.classes import BY_ITSELF, WRONG, Said, log_sum
from rotavg_ros.solver.slam.poses.priors import PlacePriors
from rotavg_ros.solver.slam.poses.repeats.exactness import Errors, InTurn, shared_ways
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.repeats.neighbours import Repeats, repeats_of, tail_share, wrong_share

_LOG_NOTHING = -1e6
# Floor of probabilities; least distance of shares from zero and one.
_LEAST_CHANCE, _SHARE = 1e-9, 0.01
# Closures that are good, or false, with a lower probability are not compared with others.
_UNLIKELY = 1e-3
# Chains are joined by closures that are right with a higher probability.
_RIGHT = 0.5
# Units of work per closure, for each part of the judgement.
_CLOSURE = 0.007


@dataclass(frozen=True)
class Judge:
    """Computes the classes of all closures from the predictions by all else.

    Attributes:
        told: results of rotations alone.
        turns: k.
        priors: prior parameters of places.
        held: ``(C,)`` bool, labels of rotations, held fixed; None: judged by their densities.
        counts_tails: whether the share of tails is estimated, or that of the prior.
    """

    told: Told
    turns: int
    priors: PlacePriors
    held: np.ndarray | None
    counts_tails: bool

    def __call__(
        self, predictions: Predictions, maps: MapTurns, before: np.ndarray, scale: Scale, *, in_order: bool = False
    ) -> Places:
        """Classes under one choice of noise.

        Args:
            predictions: predictions by all else.
            maps: turns of the map that would explain the closures' discrepancies.
            before: ``(J + 1, C)`` previous probabilities, which tell how common wrong places are.
            scale: scales of errors.
            in_order: given only the closures before, so that densities multiply to the joint one; else all others.
        """
        told, known = self.told, self.told.is_known
        is_joined = told.joined(before[:GOOD].sum(axis=0) > _RIGHT)
        said = Said.of(predictions, told, is_joined, self.turns, scale, self.priors)
        spend(_CLOSURE * len(known))
        log_class = said.log_turn + said.log_shift
        alone = log_sum(log_class[BY_ITSELF]) - np.log(WRONG)
        spend(2 * _CLOSURE * len(known))
        repeats = self._repeats(said, maps, before, alone, in_order=in_order)
        spend(_CLOSURE * len(known))
        in_turn, share = InTurn(told.detection, told.run, in_order), wrong_share(before, told, self.priors)
        wrong = before[GOOD:-1].sum(axis=0)
        likely = shared_ways(repeats.elsewhere, np.ones(repeats.elsewhere.shape[1]), before[REPEATS], in_turn)
        anywhere = _Others(repeats.has_elsewhere, (likely * repeats.elsewhere).sum(axis=1))
        alike = self._log_repeats(_Others(repeats.has_alike, repeats.alike), repeats, alone, wrong, in_turn)
        tails = np.full(len(known), self.priors.tails)
        if self.counts_tails:
            tails = tail_share(said.log_shift[TAILS] - said.log_shift[0], before, told, self.priors)
        log_class += self._log_classes(share, tails, alike, self._log_elsewhere(anywhere, alone, wrong, in_turn))
        # Without a translation the place cannot be judged: a closure with a correct rotation is good.
        log_class[:, ~known] = _LOG_NOTHING
        log_class[0, ~known] = said.log_turn[0, ~known]
        log_turned, log_behind = self._log_false(said, maps, repeats, before, in_turn)
        log_false = np.logaddexp(told.false_odds + log_turned, log_behind + np.log(share))
        log_false = np.where(known, log_false, told.false_odds)
        log_class = self._as_labelled(np.concatenate((log_class, log_false[None])))
        return pulls.pulled(said, told, log_class, repeats.number)

    def nothing_known(self, is_good: np.ndarray, square: np.ndarray, scale: Scale) -> Places:
        """Classes before any solve, from rotations' labels and squared translation residuals, m²."""
        return pulls.nothing_known(self.told, self.priors, is_good, square, scale)

    def _repeats(
        self, said: Said, maps: MapTurns, before: np.ndarray, log_alone: np.ndarray, *, in_order: bool
    ) -> Repeats:
        told, scale, predictions = self.told, said.scale, said.predictions.wrong
        turn, shift = (
            told.sign[:, None] * each for each in (predictions.turn(told.uneven), predictions.mean[:, self.turns :])
        )
        shift_variance, own_variance = (np.full(len(turn), each) for each in (scale.closure, scale.own_closure))
        errors = Errors(turn, shift, told.rotation_variance, shift_variance, own_variance, said.is_told)
        alone = np.exp(log_alone) * self._could_be(before[:-1].sum(axis=0), 1)
        return repeats_of(errors, maps, before, told, alone, in_order=in_order)

    def _log_classes(
        self,
        share: np.ndarray,
        tails: np.ndarray,
        log_repeats: tuple[np.ndarray, np.ndarray],
        log_elsewhere: tuple[np.ndarray, np.ndarray],
    ) -> np.ndarray:
        """``(J, C)`` nats, log prior of each class if the rotation is not false.

        Args:
            share: ``(C,)`` share of wrong places.
            tails: ``(C,)`` share of tails among good ones.
            log_repeats: log probabilities that a wrong place does not repeat a neighbour's, and that it does.
            log_elsewhere: the same, for those that repeat no neighbour's, of repeating any other.
        """
        priors = self.priors
        right, wrong = np.log1p(-share), np.log(share)
        log_alone, log_repeat = log_repeats
        log_repeat = np.logaddexp(log_repeat, log_alone + log_elsewhere[1])
        by_itself = wrong + log_alone + log_elsewhere[0] + np.log1p(-priors.from_behind) - np.log(WRONG)
        good = right + np.log1p(-tails), right + np.log(tails)
        return np.stack((*good, *[by_itself] * WRONG, wrong + log_repeat))

    def _log_false(
        self, said: Said, maps: MapTurns, repeats: Repeats, before: np.ndarray, in_turn: InTurn
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` nats each: of shifts of closures whose rotation is false; of turn and shift, seen from behind.

        The first join wrong places, or the right one turned; all may repeat others.
        """
        priors, told = self.priors, self.told
        log_wrong = said.log_anywhere + np.log1p(-priors.turned_in_place)
        log_right = said.log_in_place + np.log(priors.turned_in_place)
        by_itself = np.logaddexp(log_wrong, log_right)
        wrong = before[-1] * expit(log_wrong - log_right) * said.is_told
        could_be = self._could_be(before[-1], 0) & said.is_told
        has_turned, turned = maps.repeats(wrong, by_itself, told, could_be, in_order=in_turn.by_those_before)
        spend(_CLOSURE * len(repeats.turned))
        # The same wrong places as before, or as all that are off by the same turn of the map.
        ways = np.concatenate((repeats.turned, repeats.has_turned[:, None] * turned), axis=1)
        with np.errstate(divide="ignore"):
            is_repeat = before[-1] * expit(np.log(ways.mean(axis=1)) - by_itself)
        likely = shared_ways(ways, np.ones(ways.shape[1]), is_repeat, in_turn)
        of_maps = likely[:, repeats.turned.shape[1] :]
        again = _Others(repeats.has_turned, (likely * ways).sum(axis=1))
        anywhere = _Others(has_turned, (of_maps * turned).sum(axis=1) / of_maps.sum(axis=1))
        log_alone, log_repeat = self._log_repeats(again, repeats, by_itself, before[-1], in_turn)
        log_nobodys, log_elsewhere = self._log_elsewhere(anywhere, by_itself, wrong, in_turn)
        elsewhere = np.logaddexp(by_itself + log_nobodys, log_elsewhere)
        behind = log_alone + np.log(priors.from_behind) + said.log_anywhere
        log_behind = log_from_behind(said.predictions.wrong, told.uneven, said.turned[1])
        return np.logaddexp(log_alone + elsewhere, log_repeat), log_behind + np.logaddexp(behind, log_repeat)

    def _could_be(self, chance: np.ndarray, label: int) -> np.ndarray:
        """``(C,)`` bool, closures whose rotation may be good (1) or false (0); the others are not compared."""
        return chance > _UNLIKELY if self.held is None else self.held == label

    def _log_repeats(
        self, again: _Others, repeats: Repeats, log_alone: np.ndarray, wrong: np.ndarray, in_turn: InTurn
    ) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` nats each: that a wrong place repeats no neighbour's; that it does, plus its log density then."""
        share = again.share(self.priors.repeats * self.priors.counted, (log_alone, wrong), in_turn, self.priors)
        return _log(1 - share * repeats.has_any), _log(share * again.density)

    def _log_elsewhere(
        self, anywhere: _Others, log_alone: np.ndarray, wrong: np.ndarray, in_turn: InTurn
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same for repeating any closure, wherever it is."""
        share = anywhere.share(self.priors.elsewhere * self.priors.counted, (log_alone, wrong), in_turn, self.priors)
        return _log(1 - share * anywhere.has_any), _log(share * anywhere.density)

    def _as_labelled(self, log_class: np.ndarray) -> np.ndarray:
        """Without the classes that somebody's label, or that of rotations, rules out."""
        accepted = self.told.label > 0
        is_good = accepted if self.held is None else self.held
        is_false = self.told.label < 0 if self.held is None else ~self.held
        log_class[-1, is_good] = _LOG_NOTHING
        log_class[:-1, is_false] = _LOG_NOTHING
        log_class[GOOD:, accepted & self.told.is_known] = _LOG_NOTHING
        return log_class


class _Others(NamedTuple):
    """Evidence from others about the wrong places of C closures, if they join the same ones.

    Attributes:
        has_any: ``(C,)`` expected number of such others, at most 1.
        density: ``(C,)`` density by these, times that number.
    """

    has_any: np.ndarray
    density: np.ndarray

    def share(
        self, repeats: float, alone: tuple[np.ndarray, np.ndarray], in_turn: InTurn, priors: PlacePriors
    ) -> np.ndarray:
        """Share ``(C,)`` of closures that repeat one of these, where there are any.

        Args:
            repeats: prior count of closures that do.
            alone: ``(C,)`` each: log density, nats, if it repeats none; and probability that it joins wrong places.
            in_turn: which others are evidence.
            priors: prior count of all closures.
        """
        log_alone, wrong = alone
        is_told = self.has_any > _LEAST_CHANCE
        by_these = self.density / np.maximum(self.has_any, _LEAST_CHANCE)
        kernels = np.stack((np.exp(log_alone), by_these), axis=1) * is_told[:, None]
        beforehand = np.array([priors.counted - repeats, repeats])
        likely = shared_ways(kernels, beforehand, wrong * self.has_any, in_turn)
        return np.asarray(np.clip(likely[:, 1], _SHARE, 1 - _SHARE))


def _log(density: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.asarray(np.maximum(np.log(density), _LOG_NOTHING))
