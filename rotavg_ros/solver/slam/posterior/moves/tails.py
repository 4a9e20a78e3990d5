"""Slips and tails of odometry explain the same data: moves for slips that tails explain, and tails that hide slips."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.slam.posterior.densities import log_good
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves.noise import SCALES, STEP_TAILS
from rotavg_ros.solver.slam.posterior.objective import log_noise_prior
from rotavg_ros.solver.slam.posterior.rows import tails, variances, with_noise
from rotavg_ros.solver.slam.posterior.state import STEP_TAIL_RATIOS, Noise, State


def propose_tails(mode: Mode) -> Iterator[Proposal]:
    """Take back all slips that odometry's tails explain, with those tails that explain most.

    Odometry with a few far worse segments looks like many small slips. They are not taken back one by one: without
    tails each is a slip, and while they are slips no segments are left to be in the tails.
    """
    # Segments that a label rejects stay rejected.
    slips = mode.slipped[np.isfinite(mode.problem.log_odds[mode.slipped])]
    if len(slips) == 0:
        return
    mended = min(
        (_Mended.of(mode, slips, share, ratio) for share, ratio in STEP_TAILS), key=lambda each: each.predicted
    )
    if mended.explained.any():
        yield Proposal("tails", mended.predicted, lambda: mended.state(mode), mode.problem.limits.rival)


def hides_slips(mode: Mode) -> bool:
    """Whether a segment is in wide tails that would clearly be a slip if tails were no wider than the least.

    Its error is that of a slip, and the part between two such segments may be turned, with the same evidence as slips.
    """
    noise, problem, told = mode.state.noise, mode.problem, mode.left_out
    if noise.step_tail_ratio == STEP_TAIL_RATIOS[0] or "slips" in problem.without:
        return False
    sound = np.flatnonzero(problem.graph.is_odometry & mode.state.is_good)
    own, k = variances(problem, noise)[sound], problem.components
    if_wide, if_narrow = (
        log_good(told.square[sound], own, told.predicted[sound], k, tails(problem, each).of(sound))[0]
        for each in (noise, replace(noise, step_tail_ratio=STEP_TAIL_RATIOS[0]))
    )
    return bool((told.log_odds[sound] - (if_wide - if_narrow) < -problem.limits.rival).any())


class _Mended(NamedTuple):
    """Without some of S slips.

    Attributes:
        predicted: by how much F changes, nats, if what others say of each edge stays.
        slips: ``(S,)`` edges.
        noise: θ with the tails that explain them, and the step's best variance.
        explained: ``(S,)`` bool, which of the slips.
    """

    predicted: float
    slips: np.ndarray
    noise: Noise
    explained: np.ndarray

    @classmethod
    def of(cls, mode: Mode, slips: np.ndarray, share: float, ratio: float) -> _Mended:
        """With tails of a share and ratio."""
        problem, told, before = mode.problem, mode.left_out, mode.state.noise
        noise = replace(before, step_tails=share, step_tail_ratio=ratio)
        # The slips come last.
        sound = np.flatnonzero(problem.graph.is_odometry & mode.state.is_good)
        edges = np.concatenate((sound, slips))
        square, predicted = told.square[edges], told.predicted[edges]

        def log_density(of: Noise, scale: np.ndarray) -> np.ndarray:
            own, tailed = variances(problem, of)[edges], tails(problem, of).of(edges)
            return log_good(square, scale * own, predicted, problem.components, tailed)[0]

        now = log_density(before, np.ones(1))
        now[len(sound) :] -= told.log_odds[slips]
        then = log_density(noise, SCALES[:, None])
        best = np.concatenate((then[:, : len(sound)], np.maximum(then, now)[:, len(sound) :]), axis=1)
        number = int(best.sum(axis=1).argmax())
        changed = log_noise_prior(before, problem.priors) - log_noise_prior(noise, problem.priors)
        return cls(
            float(now.sum() - best[number].sum()) + changed,
            slips,
            replace(noise, step_variance=float(SCALES[number]) * noise.step_variance),
            then[number, len(sound) :] > now[len(sound) :],
        )

    def state(self, mode: Mode) -> State:
        """To begin from."""
        trusted = mode.state.trusted.copy()
        trusted[self.slips[self.explained]] = 1.0
        return replace(with_noise(mode.problem, mode.state, self.noise), trusted=trusted)
