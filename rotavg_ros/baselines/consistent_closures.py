"""Pairwise consistency maximisation (Mangelson, Dominic, Eustice & Vasudevan, ICRA 2018).

Two closures agree where the loop through both and the odometry between their ends closes within its covariance. The
largest set of closures that all agree with each other, a clique, is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rotavg_ros.baselines.pose_least_squares import FloatArray, is_planar
from rotavg_ros.view_graph import ViewGraph

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.int64]

# Loops whose squared Mahalanobis norm exceeds this quantile do not agree. All pairs of a clique have to: at 0.99 up to
# a third of the good closures is left out, beyond 0.9999 little changes (buildings and CSAIL, seeds 0 and 1).
PROBABILITY = 0.9999
# Pairs of closures that are looked at together, and starts of the search for a clique.
_ROWS, _STARTS = 200_000, 50
_PLANAR = np.array([2, 3, 4])


@dataclass(frozen=True)
class _Chain:
    """Odometry's own poses, and prefix sums along it of what its steps' noise is moved by.

    Attributes:
        world_from_body, position: of N keyframes.
        count, sum, moment: ``(N,)``, ``(N, 3)`` and ``(N, 3, 3)``: of steps up to a keyframe, their ends, and the ends'
            outer products.
    """

    world_from_body: Rotation
    position: FloatArray
    count: FloatArray
    sum: FloatArray
    moment: FloatArray

    @classmethod
    def along(cls, world_from_body: Rotation, position: FloatArray) -> _Chain:
        outer = position[:, :, None] * position[:, None, :]
        first = np.zeros_like(position[:1])
        count = np.arange(len(position), dtype=np.float64)
        sums = np.concatenate((first, np.cumsum(position[1:], axis=0)))
        moments = np.concatenate((np.zeros((1, 3, 3)), np.cumsum(outer[1:], axis=0)))
        return cls(world_from_body, position, count, sums, moments)

    def between(self, start: IndexArray, end: IndexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the steps between two keyframes, whichever is passed first: count, sum and moment of their ends."""
        first, last = np.minimum(start, end), np.maximum(start, end)
        return tuple(prefix[last] - prefix[first] for prefix in (self.count, self.sum, self.moment))  # type: ignore[return-value]


@dataclass(frozen=True)
class _Pose:
    """Many poses in many frames."""

    turn: Rotation
    shift: FloatArray

    def __matmul__(self, other: _Pose) -> _Pose:
        return _Pose(self.turn * other.turn, self.shift + self.turn.apply(other.shift).reshape(-1, 3))

    def inv(self) -> _Pose:
        return _Pose(self.turn.inv(), -self.turn.inv().apply(self.shift).reshape(-1, 3))

    def __getitem__(self, which: IndexArray) -> _Pose:
        return _Pose(self.turn[which], self.shift[which])


def consistent_closures(graph: ViewGraph, sigma: FloatArray, odometry: tuple[FloatArray, FloatArray]) -> BoolArray:
    """``(M,)``: odometry, and the closures of the largest set that a greedy search finds to agree.

    Args:
        graph: one chain of odometry through all nodes in their order, every edge with a translation.
        sigma: ``(M, 2)`` rad and metres per component; of odometry the median counts.
        odometry: positions ``(N, 3)`` metres and world_from_body ``(N, 4)`` xyzw along it.
    """
    closures = np.flatnonzero(~graph.is_odometry.numpy())
    kept = graph.is_odometry.numpy().copy()
    kept[closures[largest_clique(agreement(graph, sigma, odometry, closures))]] = True
    return np.asarray(kept)


def largest_clique(agrees: BoolArray) -> IndexArray:
    """Members of a large clique, ascending: greedy from the 50 vertices of most neighbours.

    From each, its neighbours join in the order of how many of the others they agree with (after Pattabiraman et al.
    2013).

    Args:
        agrees: ``(K, K)`` symmetric.
    """
    agrees = agrees & ~np.eye(len(agrees), dtype=bool)
    degree = agrees.sum(axis=1)
    best: list[int] = []
    for start in np.argsort(-degree, kind="stable")[:_STARTS].tolist():
        left = agrees[start].copy()
        near = np.flatnonzero(left)
        clique = [start]
        for candidate in near[np.argsort(-agrees[np.ix_(near, near)].sum(axis=1), kind="stable")].tolist():
            if left[candidate]:
                clique.append(candidate)
                left &= agrees[candidate]
        best = max(best, clique, key=len)
    return np.array(sorted(best), dtype=np.int64)


def agreement(
    graph: ViewGraph,
    sigma: FloatArray,
    odometry: tuple[FloatArray, FloatArray],
    closures: IndexArray,
    probability: float = PROBABILITY,
) -> BoolArray:
    """``(K, K)``: which closures agree with which.

    Args:
        graph, sigma, odometry: see :func:`consistent_closures`.
        closures: ``(K,)`` edges.
        probability: with which two good closures agree.
    """
    assert graph.translation is not None
    chain = _Chain.along(Rotation.from_quat(odometry[1]), odometry[0])
    components = _PLANAR if is_planar(graph) else np.arange(6)
    threshold = float(chi2.ppf(probability, len(components)))
    earlier, later, measured = _from_the_earlier_end(graph, closures)
    step = np.median(sigma[graph.is_odometry.numpy()], axis=0)
    first, second = np.triu_indices(len(closures), 1)
    agrees = np.eye(len(closures), dtype=bool)
    for begin in range(0, len(first), _ROWS):
        a, b = first[begin : begin + _ROWS], second[begin : begin + _ROWS]
        # The closure that ends earlier is the first.
        a, b = np.where(later[a] <= later[b], a, b), np.where(later[a] <= later[b], b, a)
        loop = _Loop(chain, measured[a], measured[b], (earlier[a], later[a]), (earlier[b], later[b]))
        residual, covariance = loop.closed(step, sigma[closures[a]], sigma[closures[b]])
        residual, covariance = residual[:, components], covariance[:, components][:, :, components]
        norm = (residual * np.linalg.solve(covariance, residual[:, :, None])[:, :, 0]).sum(axis=1)
        agrees[a, b] = agrees[b, a] = norm <= threshold
    return agrees


def _from_the_earlier_end(graph: ViewGraph, closures: IndexArray) -> tuple[IndexArray, IndexArray, _Pose]:
    """Earlier and later ends, and poses of the later in the frame of the earlier."""
    assert graph.translation is not None
    source, target = graph.source.numpy()[closures], graph.target.numpy()[closures]
    rotation = Rotation.from_quat(graph.target_from_source.numpy()[closures])
    forward = _Pose(rotation.inv(), graph.translation.numpy()[closures])
    backward, runs_forward = forward.inv(), source < target
    turn = np.where(runs_forward[:, None], forward.turn.as_quat(), backward.turn.as_quat())
    shift = np.where(runs_forward[:, None], forward.shift, backward.shift)
    return np.minimum(source, target), np.maximum(source, target), _Pose(Rotation.from_quat(turn), shift)


@dataclass(frozen=True)
class _Loop:
    """Along one closure, the odometry to the other's later end, that one backwards, and the odometry home.

    Closures run from the earlier to the later end, and the first ends no later than the second. Steps of odometry that
    are passed twice, since the second closure begins after the first has ended, are passed in opposite directions from
    nearly the same place: their noise takes itself away.
    """

    chain: _Chain
    there: _Pose
    back: _Pose
    ends_there: tuple[IndexArray, IndexArray]
    ends_back: tuple[IndexArray, IndexArray]

    def closed(self, step: FloatArray, there: FloatArray, back: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Turn and shift ``(K, 6)`` by which it does not close, and their covariance ``(K, 6, 6)``.

        A turn δ at q moves the loop's end e by δ × (e − q).

        Args:
            step: ``(2,)`` deviation of one step of odometry; there, back: ``(K, 2)`` those of the closures.
        """
        (source, target), (other_source, other_target) = self.ends_there, self.ends_back
        poses = _Pose(self.chain.world_from_body, self.chain.position)
        second = self.there
        third = second @ (poses[target].inv() @ poses[other_target])
        fourth = third @ self.back.inv()
        end = fourth @ (poses[other_source].inv() @ poses[source])
        covariance = np.zeros((len(source), 6, 6))
        one = np.ones(len(source))
        for sigma, at in ((there, second.shift), (back, third.shift)):
            arm = end.shift - at
            _add(covariance, sigma, (one, arm, arm[:, :, None] * arm[:, None, :]))
        once = np.maximum(target, other_source), np.minimum(target, other_source)
        for entered, start, ends in (
            (second, target, (once[0], other_target)),
            (fourth, other_source, (source, once[1])),
        ):
            arms = self._arms(entered @ poses[start].inv(), ends, end.shift)
            _add(covariance, np.broadcast_to(step, (len(source), 2)), arms)
        return np.concatenate((end.turn.as_rotvec(), end.shift), axis=1), covariance

    def _arms(
        self, moved: _Pose, ends: tuple[IndexArray, IndexArray], end: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Number, sum and second moment of e − q over steps of odometry that ``moved`` takes to where the loop is."""
        count, total, moment = self.chain.between(*ends)
        turn = moved.turn.as_matrix()
        # e − (A q + s) = (e − s) − A q.
        rest = end - moved.shift
        turned = np.einsum("kij,kj->ki", turn, total)
        cross = rest[:, :, None] * turned[:, None, :]
        second = count[:, None, None] * rest[:, :, None] * rest[:, None, :] - cross - cross.transpose(0, 2, 1)
        return count, count[:, None] * rest - turned, second + turn @ moment @ turn.transpose(0, 2, 1)


def _add(covariance: FloatArray, sigma: FloatArray, arms: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    """Noise of steps whose arms to the loop's end are given as count, sum and second moment.

    Cov(δ, δ × d) = σ² [d]×, Cov(δ × d) = σ² (‖d‖² I − d dᵀ).
    """
    count, total, moment = arms
    turn, shift = sigma[:, 0] ** 2, sigma[:, 1] ** 2
    identity = np.eye(3)
    x, y, z = total.T
    cross = np.zeros((len(total), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross -= cross.transpose(0, 2, 1)
    covariance[:, :3, :3] += (turn * count)[:, None, None] * identity
    # δ × d = −[d]× δ.
    covariance[:, 3:, :3] -= turn[:, None, None] * cross
    covariance[:, :3, 3:] += turn[:, None, None] * cross
    spread = np.trace(moment, axis1=1, axis2=2)
    covariance[:, 3:, 3:] += turn[:, None, None] * (spread[:, None, None] * identity - moment)
    covariance[:, 3:, 3:] += (shift * count)[:, None, None] * identity
