"""What loop closures say of each other and of the odometry between them: verdicts that a slip elsewhere does not touch.

Two neighbouring closures and the two short stretches of odometry between their ends form a cycle. It closes if all of
them are good; if one is not, it is off by anything. Belief propagation over all such cycles (each a factor "all good →
Gaussian, else uniform") tells which closures are good without ever trusting a long stretch of odometry.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.model import NoiseModel

_ROUNDS = 20
_DAMPING = 0.5
# Messages that all change by less than this, in nats, are final; what they are kept within, and probabilities.
_SETTLED = 0.02
_MAX_LOG_ODDS = 50.0
_MIN_PROBABILITY = np.float32(1e-6)
# Cycles that share a closure share its error; each counts this much of an independent one.
_TEMPER = 0.5
# A cycle through more segments than this tells nobody's fault.
_MAX_SEGMENTS = 12


@dataclass(frozen=True)
class CycleVotes:
    """Log-odds of being good, closures ``(C,)`` and segments ``(S,)``."""

    closure: np.ndarray
    segment: np.ndarray


def count_votes(
    graph: ClosureGraph,
    pairs: AgreementPairs,
    noise: NoiseModel,
    closure_log_odds: np.ndarray,
    segment_log_odds: np.ndarray,
) -> CycleVotes:
    """Belief propagation over the cycles of neighbouring closures.

    Args:
        noise: variances of steps and closures.
        closure_log_odds: ``(C,)`` prior log-odds of each closure to be good; finite.
        segment_log_odds: ``(S,)`` the same of each segment.
    """
    num_segments = graph.num_segments
    first, member, square, steps = _cycles(graph, pairs)
    prior = np.concatenate((segment_log_odds, closure_log_odds))
    if len(square) == 0:
        return CycleVotes(prior[num_segments:], prior[:num_segments])
    variance = np.maximum(steps, 0.5) * noise.step_variance + 2 * noise.closure_variance
    closes = noise.inlier_log_odds(square, variance)
    length = np.diff(first, append=len(member))
    # By how much likelier the cycle's discrepancy is if all are good; messages are good to 1e-6 in single precision.
    ratio = np.repeat(np.exp(np.clip(closes, -_MAX_LOG_ODDS, _MAX_LOG_ODDS)), length).astype(np.float32)
    message = np.zeros(len(member), dtype=np.float32)
    for _ in range(_ROUNDS):
        belief = prior + np.bincount(member, message, len(prior))
        not_good = np.exp(np.minimum(message - belief.astype(np.float32)[member], _MAX_LOG_ODDS))
        is_good = np.maximum(1 / (1 + not_good), _MIN_PROBABILITY)
        all_good = np.repeat(np.multiply.reduceat(is_good, first), length)
        others_good = np.minimum(all_good / is_good, 1 - _MIN_PROBABILITY)
        vote = np.log(1 - others_good + others_good * ratio)
        change = (1 - _DAMPING) * (_TEMPER * vote - message)
        message += change
        if np.abs(change).max() < _SETTLED:
            break
    belief = prior + np.bincount(member, message, len(prior))
    return CycleVotes(belief[num_segments:], belief[:num_segments])


def _cycles(graph: ClosureGraph, pairs: AgreementPairs) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """First member of every cycle, members (segments first, then closures); squared angle and steps of every cycle."""
    closure, num_segments = np.flatnonzero(graph.is_closure), graph.num_segments
    first, second = np.minimum(pairs.first, pairs.second), np.maximum(pairs.first, pairs.second)
    _, unique = np.unique(first * np.int64(len(closure)) + second, return_index=True)
    first, second = first[unique], second[unique]

    position = graph.position
    segment_end = np.maximum(position[graph.source[:num_segments]], position[graph.target[:num_segments]])
    order = np.argsort(segment_end, kind="stable")
    source, target = position[graph.source[closure]], position[graph.target[closure]]
    begins, counts = [], []
    for end in (np.minimum(source, target), np.maximum(source, target)):
        begin = np.searchsorted(segment_end[order], np.minimum(end[first], end[second]), side="right")
        stop = np.searchsorted(segment_end[order], np.maximum(end[first], end[second]), side="right")
        begins.append(begin)
        counts.append(stop - begin)
    kept = np.flatnonzero(counts[0] + counts[1] <= _MAX_SEGMENTS)
    number = np.arange(len(kept))
    cycle, member = [number, number], [num_segments + first[kept], num_segments + second[kept]]
    for begin, count in zip(begins, counts, strict=True):
        begin, count = begin[kept], count[kept]
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        cycle.append(np.repeat(number, count))
        member.append(order[np.repeat(begin, count) + within])
    by_cycle = np.argsort(np.concatenate(cycle), kind="stable")
    chosen = unique[kept]
    lengths = 2 + (counts[0] + counts[1])[kept]
    members = np.concatenate(member)[by_cycle]
    return np.cumsum(lengths) - lengths, members, pairs.squared_angle[chosen], pairs.steps[chosen]
