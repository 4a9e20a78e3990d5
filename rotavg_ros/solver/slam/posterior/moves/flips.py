"""Flip single labels, many at once; and false closures that only together can be good."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.left_out import relabelled
from rotavg_ros.solver.slam.posterior.mode import Mode

# If a batch does not lower F, this most certain part of it is tried.
_PART = 0.25
# Labels are flipped if log-odds contradict them by this many nats; the others count as undecided.
_DECIDED = 1.0
# Assumed largest decrease of F in a further round, in units of that of the last round.
_HOPE = 3
# Least decrease of F, in nats, that counts.
_LEAST_GAIN = 0.1


def flipped(mode: Mode, limit: float = np.inf) -> Mode:
    """Flips all labels that leave-one-out log-odds contradict, as long as F falls.

    Args:
        mode: where to begin.
        limit: nats; gives up where F would not get below it even if it fell a few times as fast as in the last round.
    """
    limits, begun, batches = mode.problem.limits, mode, _batches(mode)
    for rounds_left in range(limits.flip_rounds - 1, -1, -1):
        if (batch := next(batches, None)) is None:
            break
        trusted = mode.state.trusted.copy()
        trusted[batch] = ~mode.state.is_good[batch]
        tried = _polished(mode, trusted, limits.trial_solves)
        gain = mode.cost - tried.cost
        if gain > _LEAST_GAIN:
            mode, batches = tried, _batches(tried)
            if mode.cost - _HOPE * rounds_left * gain > limit:
                return mode
    return mode if mode is begun else _polished(mode, mode.state.trusted, limits.polish_solves)


def _batches(mode: Mode) -> Iterator[np.ndarray]:
    """Batches of edges to be flipped together, tried until one lowers F."""
    wrong = _wrong(mode)
    while len(wrong):
        yield wrong
        wrong = wrong[: max(1, int(_PART * len(wrong)))] if len(wrong) > 1 else wrong[:0]
    for together in (_believed_alone(mode), _fitting(mode)):
        if len(together):
            yield together


def _wrong(mode: Mode) -> np.ndarray:
    """Edges whose label the log-odds contradict, the most certain first."""
    log_odds, good = mode.left_out.log_odds, mode.state.is_good
    against = np.where(good, -log_odds, log_odds)
    wrong = np.flatnonzero(~np.isinf(mode.problem.log_odds) & (against > _DECIDED))
    return wrong[np.argsort(-against[wrong], kind="stable")]


def _believed_alone(mode: Mode) -> np.ndarray:
    """False closures that would be good if none repeated another's turn.

    Closures whose errors slightly exceed those of good ones agree with each other, so one keeps the other false.
    """
    return np.flatnonzero(_may_be_good(mode) & (mode.left_out.unrepeated > 0))


def _fitting(mode: Mode) -> np.ndarray:
    """False closures that fit the current orientations.

    If nothing else joins two parts, a single closure between them gives no evidence, but all of them together do.
    """
    return np.flatnonzero(_may_be_good(mode) & (relabelled(mode.problem, mode.state) > 0))


def _may_be_good(mode: Mode) -> np.ndarray:
    """``(E,)`` bool, false closures whose label no user has set."""
    return np.asarray(~mode.state.is_good & mode.problem.graph.is_closure & ~np.isinf(mode.problem.log_odds))


def _polished(mode: Mode, trusted: np.ndarray, solves: int) -> Mode:
    state = replace(mode.state, trusted=trusted)
    return Mode(mode.problem, *polish(mode.problem, state, solves), mode.origin)
