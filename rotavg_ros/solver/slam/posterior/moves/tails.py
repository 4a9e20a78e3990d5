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
    """Proposes to take back all slips that odometry's tails explain, with those tails that explain most.

    Odometry with a few far worse segments looks like many small slips. Taking them back one by one fails: without tails
    each is a slip, and as long as all of them are slips there is no evidence for tails.
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


def hidden_slips(mode: Mode) -> np.ndarray:
    """Segments in wide tails that would clearly be slips if tails had the smallest ratio of the grid.

    Their errors are as large as a slip's, so the part between two such segments may be turned, as between two slips.
    """
    noise, problem, told = mode.state.noise, mode.problem, mode.left_out
    if noise.step_tail_ratio == STEP_TAIL_RATIOS[0] or "slips" in problem.without:
        return np.zeros(0, dtype=np.int64)
    sound = np.flatnonzero(problem.graph.is_odometry & mode.state.is_good)
    own, k = variances(problem, noise)[sound], problem.components
    if_wide, if_narrow = (
        log_good(told.square[sound], own, told.predicted[sound], k, tails(problem, each).of(sound))[0]
        for each in (noise, replace(noise, step_tail_ratio=STEP_TAIL_RATIOS[0]))
    )
    return np.asarray(sound[told.log_odds[sound] - (if_wide - if_narrow) < -problem.limits.rival])


class _Mended(NamedTuple):
    """A labelling with some of S slips explained by tails instead.

    Attributes:
        predicted: change of F, nats, if all other edges predict each edge as before.
        slips: ``(S,)`` edges.
        noise: θ with these tails and the best step variance.
        explained: ``(S,)`` bool, the slips that tails explain.
    """

    predicted: float
    slips: np.ndarray
    noise: Noise
    explained: np.ndarray

    @classmethod
    def of(cls, mode: Mode, slips: np.ndarray, share: float, ratio: float) -> _Mended:
        """With a given share of segments in the tails, and a given ratio of variances."""
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
        """The state to polish: the explained slips sound, under the new noise."""
        trusted = mode.state.trusted.copy()
        trusted[self.slips[self.explained]] = 1.0
        return replace(with_noise(mode.problem, mode.state, self.noise), trusted=trusted)
