"""GTSAM's graduated non-convexity and its iSAM2 on whole poses, Pose2 where motion is planar, else Pose3.

Both are told every edge's deviations and that odometry is right: it is their start, and no loss softens it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.baselines.pose_least_squares import FloatArray, is_planar
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.peers.running import INLIER_PROBABILITY, load, timed
from rotavg_ros.view_graph import ViewGraph

# For 95 % efficiency under Gaussian noise (Holland & Welsch 1977).
_CAUCHY_THRESHOLD = 2.3849
# Standard deviation of the prior on the first pose, rad and metres.
_ANCHOR_SIGMA = 1e-4


@dataclass(frozen=True)
class _Poses:
    """GTSAM's functions for poses of either dimension.

    Attributes:
        pose: quaternion xyzw and position in metres → pose.
        at: values, node → pose.
        between, prior: factors.
        sigmas: ``(2,)`` rad and metres → those of the tangent space, in its order.
    """

    pose: Callable[[FloatArray, FloatArray], Any]
    at: Callable[[Any, int], Any]
    between: Any
    prior: Any
    sigmas: Callable[[FloatArray], FloatArray]


def gnc_on_poses(graph: ViewGraph, sigma: FloatArray, odometry: tuple[FloatArray, FloatArray]) -> Answer:
    """Graduated non-convexity (truncated least squares); odometry is a known inlier.

    Args:
        graph: connected, every edge with a translation.
        sigma: ``(M, 2)`` rad and metres per component, what it is told.
        odometry: positions ``(N, 3)`` metres and world_from_body ``(N, 4)`` xyzw along it.
    """
    gtsam = load("gtsam")
    words = _words(gtsam, is_planar(graph))
    start = [words.pose(q, p) for p, q in zip(*odometry, strict=True)]
    factors = gtsam.NonlinearFactorGraph()
    for factor in _between_factors(gtsam, words, graph, sigma):
        factors.add(factor)
    factors.add(_anchor(gtsam, words, start[0]))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers([*torch.nonzero(graph.is_odometry).flatten().tolist(), graph.num_edges])
    values = gtsam.Values()
    for node, pose in enumerate(start):
        values.insert(node, pose)
    optimizer = gtsam.GncLMOptimizer(factors, values, parameters)
    optimizer.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
    clock = Clock()
    with timed(clock):
        found = optimizer.optimize()
    score = torch.from_numpy(1 - np.asarray(optimizer.getWeights())[: graph.num_edges])
    return _answer(words, found, graph.num_nodes, clock, score)


class Isam2:
    """iSAM2 with Cauchy's loss on closures, one update per node.

    Args:
        graph: one chain of odometry through all nodes in their order, every edge with a translation.
        sigma: ``(M, 2)`` rad and metres per component, what it is told.
        odometry: positions ``(N, 3)`` metres and world_from_body ``(N, 4)`` xyzw along it.
    """

    def __init__(self, graph: ViewGraph, sigma: FloatArray, odometry: tuple[FloatArray, FloatArray]) -> None:
        self._gtsam = gtsam = load("gtsam")
        self._words = words = _words(gtsam, is_planar(graph))
        self._start = [words.pose(q, p) for p, q in zip(*odometry, strict=True)]
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY_THRESHOLD)
        self._factors = [*_between_factors(gtsam, words, graph, sigma, loss)]
        arrival = np.maximum(graph.source.numpy(), graph.target.numpy())
        self._by_arrival = np.argsort(arrival, kind="stable")
        self._bounds = np.searchsorted(arrival[self._by_arrival], np.arange(graph.num_nodes + 1))
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        self._last, self._node = self._start[0], 0

    def add_node(self, clock: Clock) -> None:
        """Add the next node with its edges; the time that iSAM2 needs for it is counted."""
        gtsam, words, node = self._gtsam, self._words, self._node
        added, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for edge in self._by_arrival[self._bounds[node] : self._bounds[node + 1]].tolist():
            added.add(self._factors[edge])
        if node == 0:
            added.add(_anchor(gtsam, words, self._start[0]))
        step = self._start[max(node - 1, 0)].between(self._start[node])
        with timed(clock):
            values.insert(node, self._last.compose(step))
            self._isam.update(added, values)
            self._last = words.at(self._isam, node)
        self._node += 1

    def estimate(self) -> Any:
        """All poses so far, GTSAM's values."""
        return self._isam.calculateEstimate()

    def answer(self, clock: Clock) -> Answer:
        """The same in the form of all peers; it judges no edges."""
        return _answer(self._words, self.estimate(), self._node, clock, None)


def isam2_on_poses(graph: ViewGraph, sigma: FloatArray, odometry: tuple[FloatArray, FloatArray]) -> Answer:
    """:class:`Isam2` on all of a graph."""
    isam, clock = Isam2(graph, sigma, odometry), Clock()
    for _ in range(graph.num_nodes):
        isam.add_node(clock)
    return isam.answer(clock)


def _words(gtsam: Any, planar: bool) -> _Poses:
    if planar:
        return _Poses(
            pose=lambda q, p: gtsam.Pose2(p[0], p[1], 2 * float(np.arctan2(q[2], q[3]))),
            at=lambda values, node: _estimate(gtsam, values, node, "Pose2"),
            between=gtsam.BetweenFactorPose2,
            prior=gtsam.PriorFactorPose2,
            sigmas=lambda sigma: np.array([sigma[1], sigma[1], sigma[0]]),
        )
    return _Poses(
        pose=lambda q, p: gtsam.Pose3(gtsam.Rot3.Quaternion(q[3], q[0], q[1], q[2]), p),
        at=lambda values, node: _estimate(gtsam, values, node, "Pose3"),
        between=gtsam.BetweenFactorPose3,
        prior=gtsam.PriorFactorPose3,
        sigmas=lambda sigma: np.repeat(sigma, 3),
    )


def _estimate(gtsam: Any, values: Any, node: int, kind: str) -> Any:
    """A pose of values, or of iSAM2's estimate so far."""
    is_running = isinstance(values, gtsam.ISAM2)
    return getattr(values, f"calculateEstimate{kind}" if is_running else f"at{kind}")(node)


def _between_factors(
    gtsam: Any, words: _Poses, graph: ViewGraph, sigma: FloatArray, loss_of_closures: Any = None
) -> Iterable[Any]:
    assert graph.translation is not None
    source_from_target = Rotation.from_quat(graph.target_from_source.numpy()).inv().as_quat(canonical=True)
    is_odometry: NDArray[np.bool_] = graph.is_odometry.numpy()
    ends = zip(graph.source.tolist(), graph.target.tolist(), strict=True)
    for edge, (source, target) in enumerate(ends):
        noise = gtsam.noiseModel.Diagonal.Sigmas(words.sigmas(sigma[edge]))
        if loss_of_closures is not None and not is_odometry[edge]:
            noise = gtsam.noiseModel.Robust.Create(loss_of_closures, noise)
        pose = words.pose(source_from_target[edge], graph.translation[edge].numpy())
        yield words.between(source, target, pose, noise)


def _anchor(gtsam: Any, words: _Poses, pose: Any) -> Any:
    noise = gtsam.noiseModel.Diagonal.Sigmas(words.sigmas(np.full(2, _ANCHOR_SIGMA)))
    return words.prior(0, pose, noise)


def _answer(words: _Poses, values: Any, num_nodes: int, clock: Clock, score: torch.Tensor | None) -> Answer:
    matrices = np.array([words.at(values, node).matrix() for node in range(num_nodes)])
    planar = matrices.shape[1] == 3
    position, turn = np.zeros((num_nodes, 3)), np.tile(np.eye(3), (num_nodes, 1, 1))
    size = 2 if planar else 3
    position[:, :size], turn[:, :size, :size] = matrices[:, :size, size], matrices[:, :size, :size]
    body_from_world = torch.from_numpy(Rotation.from_matrix(turn).inv().as_quat(canonical=True))
    return Answer(body_from_world, clock.seconds, clock.cpu_seconds, score, position=torch.from_numpy(position))
