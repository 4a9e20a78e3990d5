"""Synthetic SfM view-graphs: the recipe of the paper's text, and the one of the authors' released scripts.

Both draw true orientations, choose pairs, measure them with noise about mostly vertical-plane axes, and replace or
disturb a share of the measurements. A measurement's noise is right-multiplied: ``R̃_uv = R_uv · noise``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

# Noise beyond which the paper calls an edge an outlier.
SFM_OUTLIER_ANGLE = np.radians(20.0)
# Beyond this many cameras a list of all pairs takes gigabytes.
_MAX_NODES_TO_LIST_PAIRS = 4000


class NoiseCovariance(NamedTuple):
    """Covariances of the noise of M edges, K of them different.

    Attributes:
        of_kind: ``(K, 3, 3)`` rad², in the frames of the edges' sources.
        kind: ``(M,)`` index of each edge's covariance.
    """

    of_kind: Tensor
    kind: Tensor

    def of_edges(self) -> Tensor:
        """``(M, 3, 3)`` rad²."""
        return self.of_kind[self.kind.long()]


@dataclass(frozen=True)
class SyntheticGraph:
    """A view-graph with its truth.

    Attributes:
        graph: the measurements.
        body_from_world: ``(N, 4)`` float64, true orientations.
        noise_angle: ``(M,)`` rad, angle between measured and true relative rotation.
        noise: true covariances of the edges' noise; None: unknown.
    """

    graph: ViewGraph
    body_from_world: Tensor
    noise_angle: Tensor
    noise: NoiseCovariance | None = None

    @property
    def is_outlier(self) -> Tensor:
        """``(M,)`` bool, the paper's label: noise beyond 20°."""
        return torch.gt(self.noise_angle, SFM_OUTLIER_ANGLE)


class EdgeNoise(NamedTuple):
    """Noise of the M edges of one graph.

    Attributes:
        rotation: noise of every edge, outliers included, in its source's frame.
        covariance: to first order; kind 0 is undisturbed edges, kind 1 disturbed ones.
    """

    rotation: Rotation
    covariance: NoiseCovariance


@dataclass(frozen=True)
class ReleasedRecipe:
    """The generator of the authors' released scripts. Pairs are ranges of uniform draws.

    Attributes:
        cameras: number of cameras.
        turn_deg: standard deviation of the cameras' turn.
        tilt_deg: largest additional tilt about a random axis.
        kept_share: share of the candidate pairs kept.
        overlap_deg: pairs beyond this relative angle are not kept.
        noise_deg: standard deviation of the noise's angle, per graph, before division by √3.
        outlier_share: share of the edges disturbed further, by a wide normal rotation.
        planar: turn and noise axes lie in a vertical plane; otherwise they have any direction.
        round_noise: noise axes have any direction even if ``planar``.
    """

    cameras: tuple[int, int] = (400, 1000)
    turn_deg: float = 45.0
    tilt_deg: float = 10.0
    kept_share: tuple[float, float] = (0.25, 0.5)
    overlap_deg: tuple[float, float] = (45.0, 60.0)
    noise_deg: tuple[float, float] = (15.0, 30.0)
    outlier_share: tuple[float, float] = (0.1, 0.2)
    planar: bool = True
    round_noise: bool = False

    def sample(self, rng: np.random.Generator) -> SyntheticGraph:
        """Draw one graph."""
        n = int(rng.integers(self.cameras[0], self.cameras[1] + 1))
        orientation = self.orientations(n, rng)

        # Candidates: 1-based i < j ≤ 2 (i + 2).
        first, second = np.triu_indices(n, k=1)
        candidate = second + 1 <= 2 * (first + 3)
        first, second = first[candidate], second[candidate]
        angle = _relative_angle(orientation.as_quat(), first, second)
        wanted = min(
            int(rng.uniform(*self.kept_share) * len(first)),
            int((angle < np.radians(rng.uniform(*self.overlap_deg))).sum()),
        )
        kept = np.zeros(len(first), dtype=bool)
        kept[np.argpartition(angle, min(wanted, len(angle) - 1))[:wanted]] = True
        kept[_spanning_tree_edges(n, first, second, angle)] = True
        source, target = first[kept], second[kept]
        return measured(orientation, source, target, self.noise(len(source), rng))

    def orientations(self, n: int, rng: np.random.Generator) -> Rotation:
        """True body_from_world of ``n`` cameras, in the order of their turn about the vertical."""
        turn = _axes(n, self.planar, rng) * np.radians(self.turn_deg) * rng.standard_normal((n, 1))
        turn = turn[np.argsort(turn[:, 1])]
        tilt = _axes(n, False, rng) * np.radians(rng.uniform(0, self.tilt_deg, (n, 1)))
        return Rotation.from_rotvec(turn) * Rotation.from_rotvec(tilt)

    def noise(self, m: int, rng: np.random.Generator) -> EdgeNoise:
        """Noise of the ``m`` edges of one graph, outliers included."""
        sigma = np.radians(rng.uniform(*self.noise_deg)) / np.sqrt(3)
        in_plane = self.planar and not self.round_noise
        noise = Rotation.from_rotvec(_axes(m, in_plane, rng) * sigma * rng.standard_normal((m, 1)))
        noise = noise * Rotation.from_rotvec(_axes(m, False, rng) * sigma / 10 * rng.standard_normal((m, 1)))
        disturbed = rng.choice(m, int(rng.uniform(*self.outlier_share) * m), replace=False)
        wide = np.zeros((m, 3))
        wide[disturbed] = (
            np.radians(90)
            / np.sqrt(3)
            * rng.standard_normal((len(disturbed), 1))
            * rng.standard_normal((len(disturbed), 3))
        )
        usual = sigma**2 * (_axis_moment(in_plane) + _axis_moment(False) / 100)
        disturbance = np.radians(90) ** 2 / 3 * np.eye(3)
        return EdgeNoise(noise * Rotation.from_rotvec(wide), _covariance(usual, usual + disturbance, disturbed, m))


@dataclass(frozen=True)
class PaperRecipe:
    """The generator as the paper's text describes it (§5.1). Pairs are ranges of uniform draws.

    Attributes:
        cameras: number of cameras.
        pair_share: share of all pairs that are measured.
        noise_deg: standard deviation of the noise's angle, drawn once per graph.
        outlier_share: share of the edges replaced by random rotations.
        planar: cameras are turned only about the vertical, and noise axes lie in a vertical plane; otherwise both are
            arbitrary (the paper's table 3 only says "planar" or not).
    """

    cameras: tuple[int, int] = (250, 1000)
    pair_share: tuple[float, float] = (0.1, 0.3)
    noise_deg: tuple[float, float] = (5.0, 30.0)
    outlier_share: tuple[float, float] = (0.0, 0.3)
    planar: bool = True

    def sample(self, rng: np.random.Generator) -> SyntheticGraph:
        """Draw one graph; pairs that leave cameras unconnected are joined by a random chain."""
        n = int(rng.integers(self.cameras[0], self.cameras[1] + 1))
        orientation = self.orientations(n, rng)
        source, target = _random_pairs(n, self.pair_share, rng)
        chain = rng.permutation(n)
        low, high = np.minimum(chain[:-1], chain[1:]), np.maximum(chain[:-1], chain[1:])
        missing = ~np.isin(low * n + high, source * n + target)
        source, target = np.concatenate((source, low[missing])), np.concatenate((target, high[missing]))
        return measured(orientation, source, target, self.noise(len(source), rng))

    def orientations(self, n: int, rng: np.random.Generator) -> Rotation:
        """True body_from_world of ``n`` cameras."""
        if not self.planar:
            return Rotation.from_quat(_random_quaternions(n, rng))
        yaw = np.zeros((n, 3))
        yaw[:, 1] = rng.uniform(-np.pi, np.pi, n)
        return Rotation.from_rotvec(yaw)

    def noise(self, m: int, rng: np.random.Generator) -> EdgeNoise:
        """Noise of the ``m`` edges of one graph, outliers included."""
        sigma = np.radians(rng.uniform(*self.noise_deg))
        rotvec = _axes(m, self.planar, rng) * sigma * rng.standard_normal((m, 1))
        noise = Rotation.from_rotvec(rotvec).as_quat()
        replaced = rng.choice(m, int(rng.uniform(*self.outlier_share) * m), replace=False)
        noise[replaced] = _random_quaternions(len(replaced), rng)
        covariance = _covariance(
            sigma**2 * _axis_moment(self.planar), rotations.RANDOM_VARIANCE * np.eye(3), replaced, m
        )
        return EdgeNoise(Rotation.from_quat(noise), covariance)


def measured(orientation: Rotation, source: np.ndarray, target: np.ndarray, noise: EdgeNoise) -> SyntheticGraph:
    """The graph that measures ``orientation`` (body_from_world) with right-multiplied ``noise``."""
    relative = orientation[target] * orientation[source].inv() * noise.rotation
    graph = ViewGraph.create(source, target, relative.as_quat(), num_nodes=len(orientation))
    truth, angle = orientation.as_quat(), noise.rotation.magnitude()
    return SyntheticGraph(graph, torch.from_numpy(truth), torch.from_numpy(angle), noise.covariance)


def _random_pairs(n: int, share: tuple[float, float], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Each of the pairs i < j with the same probability, itself drawn uniformly from ``share``; in row-major order."""
    if n <= _MAX_NODES_TO_LIST_PAIRS:
        first, second = np.triu_indices(n, k=1)
        kept = rng.random(len(first)) < rng.uniform(*share)
        return first[kept], second[kept]
    # Too many pairs to toss a coin for each: the gaps between the kept ones are geometric.
    probability, total = rng.uniform(*share), n * (n - 1) // 2
    expected = total * probability
    gaps = rng.geometric(probability, int(expected + 10 * np.sqrt(expected) + 10))
    position = np.cumsum(gaps) - 1
    position = position[position < total]
    row_start = np.concatenate(([0], np.cumsum(np.arange(n - 1, 0, -1))))
    row = np.searchsorted(row_start, position, side="right") - 1
    return row, position - row_start[row] + row + 1


def _axes(count: int, in_vertical_plane: bool, rng: np.random.Generator) -> np.ndarray:
    """Unit axes: ``[y, √(1 − y²), 0]`` with uniform y, or uniform on the sphere."""
    if in_vertical_plane:
        y = rng.uniform(-1, 1, count)
        return np.stack((y, np.sqrt(1 - y * y), np.zeros(count)), axis=1)
    axes = rng.standard_normal((count, 3))
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def _covariance(usual: np.ndarray, disturbed: np.ndarray, which: np.ndarray, m: int) -> NoiseCovariance:
    """Covariances of ``m`` edges, of which ``which`` are disturbed."""
    kind = torch.zeros(m, dtype=torch.uint8)
    kind[torch.from_numpy(which)] = 1
    return NoiseCovariance(torch.from_numpy(np.stack((usual, disturbed))), kind)


def _axis_moment(in_vertical_plane: bool) -> np.ndarray:
    """``(3, 3)`` second moment of :func:`_axes`."""
    return np.diag((1 / 3, 2 / 3, 0.0)) if in_vertical_plane else np.eye(3) / 3


def _random_quaternions(count: int, rng: np.random.Generator) -> np.ndarray:
    quaternions = rng.standard_normal((count, 4))
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))


def _relative_angle(quaternion: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    cosine = np.abs((quaternion @ quaternion.T)[first, second])
    return np.asarray(2 * np.arccos(np.clip(cosine, 0, 1)))


def _spanning_tree_edges(n: int, first: np.ndarray, second: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Indices of the pairs in the minimum spanning tree by relative angle."""
    graph = coo_array((np.maximum(angle, 1e-12), (first, second)), shape=(n, n)).tocsr()
    tree = minimum_spanning_tree(graph).tocoo()
    position = coo_array((np.arange(1, len(first) + 1), (first, second)), shape=(n, n)).tocsr()
    return np.asarray(position[tree.row, tree.col]).ravel() - 1
