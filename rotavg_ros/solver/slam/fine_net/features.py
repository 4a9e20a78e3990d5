"""FineNet's features: how far edges err, alone and with their neighbours, all in units of the estimated noise.

All other edges predict an edge as N(μ, p I), with μ its discrepancy. Its own noise has variance v, so μ² has the
expectation k (v + p): z² = μ² / k (v + p). The part a = v / (v + p) of z² is due to the edge's own noise. The feature
of a stretch of edges is log (Σ a z² + 1) / (Σ a + 1): 0 if predictions are uninformative, the log ratio of actual to
estimated variance if they are exact. No feature depends on frame, gauge, the noise's scale, or directions or order of
edges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.slam.fine_net.evidence import Evidence

# Steps by which stretches of odometry reach to either side; and by which ends of closures that are pooled may differ.
# Closures are pooled by run as well.
_STRETCHES = (4.0, 12.0, 36.0, 108.0)
_NEAR_ENDS = (5.0, 25.0)
# Added to squares before their logarithm, so that smaller ones are as good as zero; and largest absolute logarithm.
_LEAST = 0.1
_LARGEST_LOG = 6.0
# In one of the means, squares of standardised discrepancies are capped at this, three standard deviations.
_CAPPED = 9.0


@dataclass(frozen=True)
class FineFeatures:
    """Input of FineNet (float32) for E edges between K nodes.

    Attributes:
        edges: ``(E, NUM_FEATURES)``.
        is_odometry, is_good: ``(E,)`` bool.
        ends: ``(2, E)`` nodes.
        num_nodes: K.
        graph: ``(E,)`` which of the joined graphs each edge is of.
    """

    edges: Tensor
    is_odometry: Tensor
    is_good: Tensor
    ends: Tensor
    num_nodes: int
    graph: Tensor


def fine_features(evidence: Evidence) -> FineFeatures:
    """Features of one graph."""
    odometry, k = evidence.is_odometry, evidence.components
    total = evidence.own + evidence.predicted
    square = evidence.square / (k * total)
    told = np.where(evidence.is_good, evidence.own / total, 0.0)
    pool = _Pool(told, np.where(evidence.is_good, square, 0.0))
    fitted = evidence.residual_square / (k * evidence.own * np.maximum(evidence.rest, 1e-3))
    columns = [
        0.5 * np.log(square + _LEAST),
        0.5 * np.log(fitted + _LEAST),
        _bounded(evidence.predicted / evidence.own) / 3,
        _bounded(1 / (evidence.weight * evidence.own)),
        evidence.log_relative / 2,
        np.log1p(np.where(np.isfinite(evidence.steps), evidence.steps, 1e4)) / 3,
        *_stretches(evidence, pool),
    ]
    for cause in (np.log(evidence.turn + _LEAST), np.log(evidence.length + _LEAST), evidence.stated):
        columns += _contrast(pool, cause, evidence)
    columns += [np.full(len(told), value) for value in _of_graph(evidence, pool)]
    values = torch.from_numpy(np.clip(np.stack(columns, axis=1), -_LARGEST_LOG, _LARGEST_LOG).astype(np.float32))
    num_nodes = int(max(evidence.source.max(initial=-1), evidence.target.max(initial=-1))) + 1
    return FineFeatures(
        values,
        torch.from_numpy(odometry),
        torch.from_numpy(evidence.is_good),
        torch.from_numpy(np.stack((evidence.source, evidence.target)).astype(np.int64)),
        num_nodes,
        torch.zeros(len(told), dtype=torch.int64),
    )


def joined(several: Sequence[FineFeatures]) -> FineFeatures:
    """The features of several graphs as those of one graph with several components."""
    first = np.concatenate(([0], np.cumsum([features.num_nodes for features in several])))
    return FineFeatures(
        torch.cat([features.edges for features in several]),
        torch.cat([features.is_odometry for features in several]),
        torch.cat([features.is_good for features in several]),
        torch.cat([features.ends + int(start) for features, start in zip(several, first, strict=False)], dim=1),
        int(first[-1]),
        torch.cat([torch.full((len(features.edges),), number) for number, features in enumerate(several)]),
    )


class _Pool:
    """Sums of a z² and a over groups of E edges, and the features that follow from them."""

    def __init__(self, told: np.ndarray, square: np.ndarray) -> None:
        self.told = told
        self.sums = np.stack((told * square, told), axis=1)
        self.square = square

    @staticmethod
    def says(sums: np.ndarray) -> list[np.ndarray]:
        """For sums ``(n, 2)``: log ratio of actual to estimated variance, and how informative it is."""
        return [np.log((sums[:, 0] + 1) / (sums[:, 1] + 1)), np.log1p(sums[:, 1]) / 2]

    def sorted(self, position: np.ndarray, of: np.ndarray) -> _Sorted:
        """The edges ``of`` ``(m,)``, sorted by ``position`` ``(m,)``."""
        order = np.argsort(position, kind="stable")
        return _Sorted(position[order], np.concatenate((np.zeros((1, 2)), np.cumsum(self.sums[of[order]], axis=0))))


class _Sorted(NamedTuple):
    """Edges sorted by position, with cumulative sums."""

    position: np.ndarray
    cumulated: np.ndarray

    def within(self, reach: float, at: np.ndarray) -> np.ndarray:
        """``(n, 2)`` sums over the edges that are at most ``reach`` from each of ``at`` ``(n,)``."""
        low = self.position.searchsorted(at - reach, side="left")
        return np.asarray(self.cumulated[self.position.searchsorted(at + reach, side="right")] - self.cumulated[low])


def _stretches(evidence: Evidence, pool: _Pool) -> list[np.ndarray]:
    """Columns for segments, from stretches of odometry around them and closures near them; for closures, likewise."""
    odometry, closure = np.flatnonzero(evidence.is_odometry), np.flatnonzero(~evidence.is_odometry)
    middle = evidence.position.mean(axis=1)
    ends = evidence.position[closure]
    along = pool.sorted(middle[odometry], odometry)
    by_end = pool.sorted(np.concatenate((ends[:, 0], ends[:, 1])), np.concatenate((closure, closure)))
    columns = np.zeros((2 * (len(_STRETCHES) + 1), len(middle)))

    def fill(number: int, edges: np.ndarray, sums: np.ndarray) -> None:
        columns[2 * number : 2 * number + 2, edges] = _Pool.says(sums)

    for number, reach in enumerate(_STRETCHES):
        fill(number, odometry, along.within(reach, middle[odometry]))
    fill(len(_STRETCHES), odometry, by_end.within(_NEAR_ENDS[1], middle[odometry]))
    if len(closure):
        of_run = np.stack([np.bincount(evidence.run, part) for part in pool.sums[closure].T], axis=1)
        fill(0, closure, of_run[evidence.run])
        for number, reach in enumerate(_NEAR_ENDS, start=1):
            fill(number, closure, by_end.within(reach, ends[:, 0]) + by_end.within(reach, ends[:, 1]))
        for number, end in enumerate(ends.T, start=1 + len(_NEAR_ENDS)):
            fill(number, closure, along.within(_STRETCHES[1], end))
        # The features must not depend on which end is the older one: their mean and absolute difference.
        older, newer = columns[6:8, closure].copy(), columns[8:10, closure].copy()
        columns[6:8, closure], columns[8:10, closure] = (older + newer) / 2, np.abs(older - newer)
    return list(columns)


def _contrast(pool: _Pool, cause: np.ndarray, evidence: Evidence) -> list[np.ndarray]:
    """Three columns for a cause ``(E,)`` of errors: the cause minus its mean, its effect on the noise, their product.

    The effect is the difference in log variance ratio between edges with more of the cause and edges with less.
    """
    columns = np.zeros((3, len(cause)))
    for kind in (evidence.is_odometry, ~evidence.is_odometry):
        if not kind.any():
            continue
        centred = cause[kind] - cause[kind].mean()
        much = 1 / (1 + np.exp(-centred))
        sums = np.stack([(pool.sums[kind] * share[:, None]).sum(axis=0) for share in (much, 1 - much)])
        difference = np.subtract(*_Pool.says(sums)[0])
        columns[:, kind] = np.stack((centred, np.full(len(centred), difference), centred * difference))
    return list(columns)


def _of_graph(evidence: Evidence, pool: _Pool) -> list[float]:
    """Values that are the same for all edges: how normal the noise of each kind looks, and the chosen noise model."""
    values: list[float] = []
    for kind in (evidence.is_odometry, ~evidence.is_odometry):
        told, square = pool.told[kind], pool.square[kind]
        total = float(told.sum()) + 1e-9
        values += [
            float(_Pool.says(pool.sums[kind].sum(axis=0, keepdims=True))[0][0]),
            float((told * np.log(square + _LEAST)).sum() / total),
            float((told * np.minimum(square, _CAPPED)).sum() / total),
            float(np.log1p(total)) / 3,
        ]
    noise = evidence.noise
    return [
        *values,
        noise.log_ratio / 3,
        noise.step_tails * 5,
        noise.closure_tails * 5,
        noise.turn_share,
        noise.exponent,
        noise.common_share * (noise.run_steps > 0),
        float(evidence.components == 1),
    ]


def _bounded(ratio: np.ndarray) -> np.ndarray:
    return np.asarray(np.clip(np.log(np.maximum(ratio, 1e-9)), -_LARGEST_LOG, _LARGEST_LOG))


NUM_FEATURES = 6 + 2 * (len(_STRETCHES) + 1) + 9 + 15
