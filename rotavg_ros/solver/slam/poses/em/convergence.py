"""How estimates of poses come to rest: by how much weights, chances and variances change, and where that ends."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.slam.poses.closures import Places
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState

# Variances change by no more than this factor from solve to solve; most stay while places are sorted out, for so
# many solves at most.
_SLOWEST, HELD = 16.0, 8
# After so many it is told whether places come out as those of other poses.
_ALIKE_AFTER = 4
# Which variances do not: those of closures' shifts by themselves.
_FREE = np.array([False, False, False, True, True, False, False])
# A variance whose change is a constant multiple of the one before is set to where that leads; of these at most. The
# multiple of one that swings is negative.
_LEAST_RATIO, _LARGEST_RATIO = -2.0, 0.6
# Weights go this share of the way to what they should be, in the logarithm, those that swing less, down to the other.
_SHARE, _LEAST_SHARE = 0.5, 0.1
# At rest: a step's root mean square in standard errors; chances of classes; logarithms of variances.
_STEP_CONVERGED, _CHANCE_CONVERGED, _NOISE_CONVERGED = 0.05, 0.1, 0.1


@dataclass(frozen=True)
class Ending:
    """Where an estimate ends, if not at rest.

    Attributes:
        held_for: after so many solves, with most variances as they begin, or where places rest.
        until: where closures join the same right places as these, too.
    """

    held_for: int | None = None
    until: Places | None = None

    def is_early(self, number: int, places: Places, *, is_at_rest: bool) -> bool:
        """Whether variances need not come to rest after so many solves."""
        if self.held_for is not None and (is_at_rest or number == self.held_for):
            return True
        return self.until is not None and number >= _ALIKE_AFTER and places.is_like(self.until)


TO_REST = Ending()


def poses_rest(moved: float, places: Places, before: Places) -> bool:
    """Whether nodes moved, root mean square in standard errors, and chances of classes changed by next to nothing."""
    changed = np.abs(places.chance - before.chance).max(initial=0.0)
    return bool(moved < _STEP_CONVERGED and changed < _CHANCE_CONVERGED)


def noise_rests(change: np.ndarray) -> bool:
    """Whether logarithms of variances changed by next to nothing."""
    return bool(np.abs(change).max() < _NOISE_CONVERGED)


@dataclass(frozen=True)
class Pace:
    """How far weights of closures go towards what they should be; those that swing go less far.

    Attributes:
        share: ``(2, C)`` of the way, in the logarithm, of weights of shifts and of turns.
        change: ``(2, C)`` by what they were to change.
    """

    share: np.ndarray
    change: np.ndarray

    @classmethod
    def of(cls, closures: int) -> Pace:
        """To begin with."""
        return cls(np.full((2, closures), _SHARE), np.zeros((2, closures)))

    def towards(self, places: Places, before: Places, at_once: np.ndarray) -> tuple[Places, Pace]:
        """Places with weights between theirs and those before, and the next pace.

        Where a change turns round, the weight has passed the one that stays as it is. By the secant through both
        changes (regula falsi) 1 / (1 − r) of the last share leads there, r < 0 their ratio.

        Args:
            places, before: of C closures.
            at_once: ``(C,)`` bool, which take theirs.
        """
        used = np.stack((before.weight, before.rotation_weight))
        change = np.log(np.stack((places.weight, places.rotation_weight)) / used)
        turns_round = change * self.change < 0
        ratio = change / np.where(turns_round, self.change, 1.0)
        share = np.where(turns_round, np.maximum(self.share / (1 - ratio), _LEAST_SHARE), _SHARE)
        share = np.where(at_once, 1.0, share)
        weight, rotation_weight = used * np.exp(share * change)
        return replace(places, weight=weight, rotation_weight=rotation_weight), Pace(share, change)


def following(places: Places, problem: PoseProblem, before: PoseNoise, after: PoseNoise) -> Places:
    """With weights that are what they were in those of good closures, of which the variances are others."""
    shift = problem.own_variance(before) / problem.own_variance(after)
    turn = before.closure_turn / after.closure_turn
    return replace(places, weight=places.weight * shift, rotation_weight=places.rotation_weight * turn)


def damped(chance: np.ndarray, before: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chances ``(J + 1, C)`` to go on with, and by how much they change: halfway for closures that go to and fro."""
    change = chance - before
    swings = (change * last).sum(axis=0) < 0
    change = np.where(swings, change / 2, change)
    return before + change, change


def with_noise(state: PoseState, noise: np.ndarray, last: np.ndarray, *, is_held: bool) -> tuple[PoseState, np.ndarray]:
    """The state with other variances, where their sequence leads (Aitken 1926), and by how much they changed.

    Args:
        state: before.
        noise: ``(7,)`` logarithms of variances as estimated.
        last: ``(7,)`` how they changed before; zero where that is not to be gone on from.
        is_held: all but closures' shifts stay.
    """
    before = state.noise.logarithms
    change = noise - before
    change[~_FREE] *= not is_held
    ratio = change * last / np.maximum(last * last, np.finfo(np.float64).tiny)
    goes_on = last != 0
    reached = np.where(goes_on, change / (1 - np.clip(ratio, _LEAST_RATIO, _LARGEST_RATIO)), change)
    reached = before + np.clip(reached, -np.log(_SLOWEST), np.log(_SLOWEST))
    return replace(state, noise=PoseNoise.of(reached)), np.where(goes_on, 0.0, change)
