"""Closures over a few keyframes that are made of odometry, and so tell nothing that odometry does not.

Some front ends link each keyframe to several before it by the poses that odometry gave them (VINS' sequential edges,
the edges of ORB-SLAM's essential graph). Such an edge has odometry's errors, and perhaps some of its own. Taken for a
measurement, it seems to prove that odometry errs less than it does, and right loop closures then seem false.

A measurement beside odometry sees odometry's errors: its discrepancy has their variance, and two that span the same
steps have it in common. What is made of odometry does not see them. Loop closures do, so they tell how large they are.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import gammaincinv

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.odometry_paths import LOOP_STEPS, OdometryPaths, near_a_branch
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.noise.mixture import Discrepancies
from rotavg_ros.solver.slam.noise.model import likeliest_by_chain
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Bounds of bands of steps that are judged by themselves.
_BANDS = (0.0, 4.0, 8.0, 16.0, LOOP_STEPS)
# Closures are made of odometry if they see at most this share of the variance that loop closures see, with all but this
# probability or by so many standard errors.
_SEEN, _UNLIKELY, _SIGMAS = 0.25, 0.001, 3.0
# Edges are compared with so many others that begin next; fewer pairs than this say nothing.
_NEXT, _FEW = 4, 30
# … of one branch of odometry, with those so many ahead: the farther, the less their own errors count.
_APART = (1, 8, 32)
# … and those that contradict odometry with so many others of them.
_BESIDE = 8
# Nats by which loop closures must show that some of them are good.
_EVIDENCE = 5.0
# Number of standard deviations of its kind at which an edge is none of it, and the rounding error of a file's six
# digits, rad.
_FARTHEST, _ROUNDING = 4.0, 5e-6


def restated_odometry(graph: ViewGraph, paths: OdometryPaths) -> np.ndarray:
    """``(M,)`` bool, which closures do not see odometry's errors, and differ from it no more than others of their kind.

    Args:
        graph: as it was measured.
        paths: its paths along a forest that prefers odometry.
    """
    restated = np.zeros(graph.num_edges, dtype=bool)
    chosen = ~graph.is_odometry.numpy()[paths.outside] & np.isfinite(paths.path_steps)
    chosen &= graph.label.numpy()[paths.outside] == EdgeLabel.AUTOMATIC
    steps, end = paths.path_steps[chosen], near_a_branch(graph, paths)[chosen]
    at_branch = end >= 0
    is_loop = (steps > LOOP_STEPS) & ~at_branch
    if is_loop.all() or not is_loop.any():
        return restated
    edge, k = paths.outside[chosen], graph.rotation_components
    seen = _Seen.of(graph, paths, chosen)
    square = (seen.off**2).sum(axis=1)
    bands = [np.flatnonzero((steps > low) & (steps <= high) & ~at_branch) for low, high in pairwise(_BANDS)]
    bounds = [seen.most_variance(band, k) for band in bands]
    bands.append(np.flatnonzero(at_branch))
    bounds.append(seen.most_between(bands[-1], end[at_branch], k))
    # Of good loop closures this is more than odometry's variance: the larger part of them need not be good.
    if min(bounds) > _SEEN * float(np.median(square[is_loop] / steps[is_loop])) / _quantile(0.5, k):
        return restated
    if any(seen.a_slip(band, k) for band in bands):
        return restated
    if _is_bias(graph, paths, chosen, seen):
        return restated
    loops = Discrepancies(square[is_loop], steps[is_loop], 1, 1.0)
    noise, evidence = likeliest_by_chain(loops, k)
    for band, most in zip(bands, bounds, strict=True):
        if evidence > _EVIDENCE and most <= _SEEN * noise.step_variance:
            restated[edge[band[is_of_its_kind(square[band], k)]]] = True
    return restated


def is_of_its_kind(square: np.ndarray, components: int) -> np.ndarray:
    """``(n,)`` bool, which squared discrepancies are no larger than is usual among them; NaN is not."""
    return np.asarray(square <= _FARTHEST**2 * components * _usual(square, components))


def _is_bias(graph: ViewGraph, paths: OdometryPaths, chosen: np.ndarray, seen: _Seen) -> bool:
    """Whether closures over a few steps say that odometry turns too far at every step alike, and loops confirm it.

    What is made of odometry has its bias, and does not see it.

    Args:
        graph: as it was measured.
        paths: its paths.
        chosen: ``(F,)`` bool, closures.
        seen: what they see.
    """
    steps = paths.path_steps[chosen]
    at_branch = near_a_branch(graph, paths)[chosen] >= 0
    short, is_loop = np.flatnonzero((steps <= LOOP_STEPS) & ~at_branch), (steps > LOOP_STEPS) & ~at_branch
    if len(short) == 0:
        return False
    ends = torch.stack((graph.source, graph.target))[:, paths.outside[chosen][short]]
    older = torch.where(torch.from_numpy(paths.position)[ends].argmin(dim=0).bool(), ends[1], ends[0])
    turned = rotations.rotate(paths.orientation[older], torch.from_numpy(seen.off[short])).numpy()
    rate = -turned / steps[short, None]
    rate = rate[is_of_its_kind((rate**2).sum(axis=1), graph.rotation_components)]
    bias, spread = rate.mean(axis=0), rate.var(axis=0).sum()
    if (bias**2).sum() * len(rate) <= spread * _quantile(1 - _UNLIKELY, graph.rotation_components):
        return False
    corrected = OdometryPaths.along(without_bias(graph, bias), paths.forest)
    square = [(rotations.log(each.residual[torch.from_numpy(chosen)]) ** 2).sum(dim=1) for each in (paths, corrected)]
    before, after = (np.median(each.numpy()[is_loop] / steps[is_loop]) for each in square)
    return bool(after < _SEEN * before)


def _quantile(probability: float, freedom: int) -> float:
    """Quantile of χ² with some degrees of freedom."""
    return float(2 * gammaincinv(freedom / 2, probability))


def _usual(square: np.ndarray, components: int) -> float:
    """Variance per component of vectors with these squared lengths if most of them are of one kind."""
    known = square[np.isfinite(square)]
    return max(float(np.median(known)) / _quantile(0.5, components), _ROUNDING**2) if len(known) else 0.0


class _Seen(NamedTuple):
    """What n closures see of odometry's errors.

    Attributes:
        off: ``(n, 3)`` rad, discrepancies with odometry, from the older end to the newer, in a common frame.
        first, last: ``(n,)`` positions of the ends along odometry; chains are far apart.
        of_last: ``(n,)`` the node at the last.
    """

    off: np.ndarray
    first: np.ndarray
    last: np.ndarray
    of_last: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph, paths: OdometryPaths, chosen: np.ndarray) -> _Seen:
        """Of those of the edges outside the forest that ``(F,)`` bool chooses."""
        edge = paths.outside[chosen]
        apart = paths.position.max(initial=0.0) + 1.0
        position = paths.position + apart * np.unique(paths.chain, return_inverse=True)[1]
        ends = np.stack([position[each.numpy()[edge]] for each in (graph.source, graph.target)])
        off = rotations.log(paths.residual).numpy()[chosen]
        nodes = np.stack([each.numpy()[edge] for each in (graph.source, graph.target)])
        is_last = ends[0] > ends[1]
        of_last = np.where(is_last, nodes[0], nodes[1])
        return cls(np.where(is_last[:, None], -off, off), ends.min(axis=0), ends.max(axis=0), of_last)

    def most_between(self, among: np.ndarray, end: np.ndarray, components: int) -> float:
        """The same bound from pairs of closures ``(m,)`` from one branch of odometry ``(m,)``; inf if there are none.

        What two say of the way between their other ends contains odometry's error on it.
        """
        at = np.where(self.of_last[among] == end, self.first[among], self.last[among])
        off = np.where((self.of_last[among] == end)[:, None], self.off[among], -self.off[among])
        order = np.lexsort((at, end))
        at, off, end = at[order], off[order], end[order]
        bound = np.inf
        for ahead in _APART:
            one, other = slice(None, -ahead), slice(ahead, None)
            steps = at[other] - at[one]
            pair = (end[other] == end[one]) & (steps > 0)
            if pair.sum() >= _FEW:
                square = ((off[other] - off[one])[pair] ** 2).sum(axis=1) / steps[pair]
                square = np.minimum(square, _FARTHEST**2 * components * _usual(square, components))
                bound = min(bound, float(square.sum() / _quantile(_UNLIKELY, components * len(square))))
        return bound

    def a_slip(self, among: np.ndarray, components: int) -> bool:
        """Whether two of these closures ``(m,)`` over a common step, with no end in common, contradict it alike.

        Odometry slipped there. Where one is false by itself no other agrees with it.
        """
        square = (self.off[among] ** 2).sum(axis=1)
        far = among[~is_of_its_kind(square, components)]
        far = far[np.lexsort((self.last[far], self.first[far]))]
        most = 2 * _FARTHEST**2 * components * _usual(square, components)
        for ahead in range(1, min(_BESIDE, len(far) - 1) + 1):
            one, other = far[:-ahead], far[ahead:]
            overlaps = (self.first[one] < self.first[other]) & (self.first[other] < self.last[one])
            alike = ((self.off[one] - self.off[other]) ** 2).sum(axis=1) <= most
            if (overlaps & alike & (self.last[one] != self.last[other])).any():
                return True
        return False

    def most_variance(self, among: np.ndarray, components: int) -> float:
        """rad² a step: bound on the variance of odometry that these closures ``(m,)`` see; inf if there are none.

        Their own squares contain it. Over few steps, where their own errors are larger, products of two that overlap
        tell more.
        """
        among = among[self.last[among] > self.first[among]]
        if len(among) == 0:
            return np.inf
        order = among[np.argsort(self.first[among], kind="stable")]
        off, first, last = self.off[order], self.first[order], self.last[order]
        square = (off**2).sum(axis=1)
        # False closures are not to hide what the others have in common.
        farthest = _FARTHEST**2 * components * _usual(square, components)
        off *= np.sqrt(np.minimum(1.0, farthest / np.maximum(square, _ROUNDING**2)))[:, None]
        square = np.minimum(square, farthest)
        least = float((square / (last - first)).sum() / _quantile(_UNLIKELY, components * len(among)))
        product, overlap = [], []
        for ahead in range(1, _NEXT + 1):
            common = np.minimum(last[:-ahead], last[ahead:]) - first[ahead:]
            shares = (common > 0) & ((last - first)[ahead:] <= _BANDS[1])
            product.append((off[:-ahead] * off[ahead:]).sum(axis=1)[shares])
            overlap.append(common[shares])
        value, common = np.concatenate(product), np.concatenate(overlap)
        if len(value) < _FEW:
            return least
        mean = value.sum() / common.sum()
        error = np.sqrt(((value - mean * common) ** 2).sum()) / common.sum()
        return min(least, float(mean + _SIGMAS * error) / components)
