"""Convergence of estimates of poses: damping of weights, probabilities and variances, and stopping criteria."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.closures import Places
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import own_variance
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState

# Largest factor by which variances change from solve to solve; maximum number of solves for which most variances are
# held while places are decided.
_SLOWEST, HELD = 16.0, 8
# Number of solves after which it is checked whether places end as those of other poses.
_ALIKE_AFTER = 4
# Variances that are not held: those of closures' shifts.
_FREE = np.array([False, False, False, True, True, False, False, False, False])
# Bounds of the ratio of successive changes with which a variance is extrapolated to its limit; the ratio of an
# alternating one is negative.
_LEAST_RATIO, _LARGEST_RATIO = -2.0, 0.6
# Share of the way, in the logarithm, that weights move to their targets; for alternating ones, at least the second.
_SHARE, _LEAST_SHARE = 0.5, 0.1
# Convergence limits: a step's root mean square in standard errors; class probabilities; logarithms of variances; and of
# weights, times leverages.
_STEP_CONVERGED, _CHANCE_CONVERGED, _NOISE_CONVERGED, _WEIGHT_CONVERGED = 0.05, 0.1, 0.1, 0.1


@dataclass(frozen=True)
class Ending:
    """When an estimate ends before convergence.

    Attributes:
        held_for: number of solves after which it ends, with most variances held, or earlier once places have converged.
        until: it also ends where the same closures join right places as in these.
        is_for_more: with ``until``, it also ends where none does besides those: what its start believed of others has
            been rejected again.
    """

    held_for: int | None = None
    until: Places | None = None
    is_for_more: bool = False

    def is_early(self, number: int, places: Places, *, is_at_rest: bool) -> bool:
        """Whether to end after ``number`` solves although variances have not converged."""
        if self.held_for is not None and (is_at_rest or number == self.held_for):
            return True
        return number >= _ALIKE_AFTER and self.is_reached(places)

    def is_reached(self, places: Places) -> bool:
        """Whether places are no other than in ``until``, or with ``is_for_more`` nothing besides."""
        if self.until is None:
            return False
        return places.is_like(self.until) or (self.is_for_more and places.is_within(self.until))


TO_REST = Ending()


def poses_rest(moved: float, places: Places, before: Places, leverage: np.ndarray) -> bool:
    """Whether the step (root mean square in standard errors) and the changes of classes and of weights are negligible.

    A weight counts by how far its closure determines itself: one that alone joins a robot moves no answer, but tells
    how uncertain the robot is.

    Args:
        moved: the step.
        places, before: new and previous places of C closures.
        leverage: ``(2, C)`` of their shifts and of their turns.
    """
    if not moved < _STEP_CONVERGED or np.abs(places.chance - before.chance).max(initial=0.0) >= _CHANCE_CONVERGED:
        return False
    reweighted = _log_change(places, before)
    return bool((np.abs(reweighted) * leverage).max(initial=0.0) < _WEIGHT_CONVERGED)


def _log_change(places: Places, before: Places) -> np.ndarray:
    """``(2, C)`` logarithms of the factors by which weights of shifts and of turns change."""
    after, used = (np.stack((each.weight, each.rotation_weight)) for each in (places, before))
    return np.asarray(np.log(after / used))


def noise_rests(change: np.ndarray) -> bool:
    """Whether the changes of the variances' logarithms are negligible."""
    return bool(np.abs(change).max() < _NOISE_CONVERGED)


@dataclass(frozen=True)
class Pace:
    """How far weights of closures move towards their targets; alternating ones move less.

    Attributes:
        share: ``(2, C)`` share of the way, in the logarithm, for weights of shifts and of turns.
        change: ``(2, C)`` the last full changes.
    """

    share: np.ndarray
    change: np.ndarray

    @classmethod
    def of(cls, closures: int) -> Pace:
        """The initial pace."""
        return cls(np.full((2, closures), _SHARE), np.zeros((2, closures)))

    def towards(self, places: Places, before: Places, at_once: np.ndarray) -> tuple[Places, Pace]:
        """Places with weights between the new and the previous ones, and the next pace.

        Where a change reverses, the weight has passed its fixed point. The secant through both changes (regula falsi)
        gives 1 / (1 − r) of the last share, with r < 0 their ratio.

        Args:
            places, before: new and previous places of C closures.
            at_once: ``(C,)`` bool, closures that take the new weights at once.
        """
        used = np.stack((before.weight, before.rotation_weight))
        change = _log_change(places, before)
        turns_round = change * self.change < 0
        ratio = change / np.where(turns_round, self.change, 1.0)
        share = np.where(turns_round, np.maximum(self.share / (1 - ratio), _LEAST_SHARE), _SHARE)
        share = np.where(at_once, 1.0, share)
        weight, rotation_weight = used * np.exp(share * change)
        return replace(places, weight=weight, rotation_weight=rotation_weight), Pace(share, change)


def following(
    places: Places, problem: PoseProblem, square_length: np.ndarray, before: PoseNoise, after: PoseNoise
) -> Places:
    """Rescales weights to new variances, keeping their ratio to the weight of a good closure.

    Args:
        places: with weights for the variances before.
        problem: the graph.
        square_length: ``(C,)`` m², squared lengths of closures.
        before, after: all variances.
    """
    shift = own_variance(problem, before, square_length) / own_variance(problem, after, square_length)
    turn = before.closure_turn / after.closure_turn
    return replace(places, weight=places.weight * shift, rotation_weight=places.rotation_weight * turn)


def damped(chance: np.ndarray, before: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Damped probabilities ``(J + 1, C)``, halfway for closures that alternate, and their changes."""
    change = chance - before
    swings = (change * last).sum(axis=0) < 0
    change = np.where(swings, change / 2, change)
    return before + change, change


def with_noise(state: PoseState, noise: np.ndarray, last: np.ndarray, *, is_held: bool) -> tuple[PoseState, np.ndarray]:
    """The state with variances extrapolated to the limit of their sequence (Aitken 1926), and their changes.

    Args:
        state: the state before.
        noise: ``(9,)`` logarithms of the estimated variances.
        last: ``(9,)`` previous changes; zero where these must not be extrapolated.
        is_held: hold all variances but those of closures' shifts.
    """
    before = state.noise.logarithms
    change = noise - before
    change[~_FREE] *= not is_held
    ratio = change * last / np.maximum(last * last, np.finfo(np.float64).tiny)
    goes_on = last != 0
    reached = np.where(goes_on, change / (1 - np.clip(ratio, _LEAST_RATIO, _LARGEST_RATIO)), change)
    reached = before + np.clip(reached, -np.log(_SLOWEST), np.log(_SLOWEST))
    return replace(state, noise=PoseNoise.of(reached)), np.where(goes_on, 0.0, change)
