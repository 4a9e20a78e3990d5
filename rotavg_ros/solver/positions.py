"""Positions from known orientations: a sparse linear least-squares problem, since ``p_target - p_source = R t``.

With the orientations fixed, translations are linear in the positions and their three axes share one scalar Laplacian.
The relative weight of odometry steps and closures, and the error at which a closure's translation counts as wrong,
were chosen on simulated runs, never on the robots reported.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.algebra.odometry_lengths import lengths_passed, typical_length, ways_passed
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianPattern

# A closure has the variance of this many typical steps of odometry in a row.
_CLOSURE_STEPS = 30.0
_PASSES = 5
# Number of standard deviations at which Geman & McClure's weight is a quarter.
_SCALE_SIGMAS = 3.0
_MEDIAN_OF_SQUARED = 0.8
# Weight of closures in the initial solve, negligible beside odometry.
_NEXT_TO_NOTHING = 1e-9


@dataclass(frozen=True)
class Translations:
    """Edges between N nodes (M of them).

    Attributes:
        source, target: ``(M,)`` ends of the edges.
        translation: ``(M, 3)`` position of the target in the source's frame, metres; an edge with NaN is left out.
        is_odometry: ``(M,)``.
        outlier_score: ``(M,)`` in [0, 1]; closures above 0.5 are left out, others weigh ``1 - score``.
        steps: ``(M,)`` odometry steps that an odometry edge stands for.
    """

    source: NDArray[np.int64]
    target: NDArray[np.int64]
    translation: NDArray[np.float64]
    is_odometry: NDArray[np.bool_]
    outlier_score: NDArray[np.float64]
    steps: NDArray[np.float64]

    @property
    def trust(self) -> NDArray[np.float64]:
        """``(M,)`` weight factor of each edge."""
        return np.where(self.is_odometry, 1.0, 1.0 - self.outlier_score)

    def usable(self) -> Translations:
        """The edges with a known translation that are trusted."""
        used = np.isfinite(self.translation).all(axis=1) & (self.trust >= 0.5)
        return Translations(**{each.name: getattr(self, each.name)[used] for each in fields(self)})


def fit_positions(
    world_from_body: NDArray[np.float64], edges: Translations, origin: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Positions that fit the translations best, with closures weighted down by their residuals.

    A closure with a correct rotation may still belong to another place that looks alike: corridors are parallel. So the
    passes begin at the positions by odometry alone, closures are judged on the scale of their own median residual, and
    distant ones lose all weight (Geman & McClure 1985).

    Args:
        world_from_body: ``(N, 4)`` xyzw.
        edges: between the nodes.
        origin: ``(N, 3)`` metres; the first node of every component gets its own, 0 for NaN.

    Returns:
        ``(N, 3)`` metres; NaN for nodes without any translation.
    """
    edges = edges.usable()
    source, target, is_odometry = edges.source, edges.target, edges.is_odometry
    steps = np.where(is_odometry, edges.steps, 1.0)
    num_nodes = len(world_from_body)
    component, roots = _components(num_nodes, source, target)
    step = Rotation.from_quat(world_from_body[source]).apply(edges.translation) if len(source) else np.empty((0, 3))
    counts = is_odometry if is_odometry.any() else np.ones(len(source), dtype=bool)
    way = ways_passed(step)
    typical = typical_length(way, steps, counts)
    weight = np.where(is_odometry, typical / lengths_passed(way, steps, typical), edges.trust / _CLOSURE_STEPS)

    pattern = LaplacianPattern(num_nodes, source, target, roots)

    def solve(share: NDArray[np.float64]) -> NDArray[np.float64]:
        return pattern.factorize(weight * share).fit(step)

    position = solve(np.where(is_odometry, 1.0, _NEXT_TO_NOTHING))
    if not is_odometry.all():
        # Closures that fit exactly have residuals of rounding size, which must not set the scale for others.
        rounding = max((np.finfo(float).eps * np.abs(step).max()) ** 2, np.finfo(float).tiny)
        for _ in range(_PASSES):
            squared = ((position[target] - position[source] - step) ** 2).sum(axis=1)
            variance = max(np.median(squared[~is_odometry]) / _MEDIAN_OF_SQUARED, rounding)
            share = 1 / (1 + squared / (_SCALE_SIGMAS**2 * variance)) ** 2
            position = solve(np.where(is_odometry, 1.0, np.maximum(share, _NEXT_TO_NOTHING)))
    position += np.nan_to_num(origin[roots])[component]
    touched = np.zeros(num_nodes, dtype=bool)
    touched[source] = touched[target] = True
    position[~touched] = np.nan
    return position


def _components(
    num_nodes: int, source: NDArray[np.int64], target: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Component of every node, ``(N,)``, and the first node of every component, ``(C,)``."""
    adjacency = coo_array((np.ones(len(source), dtype=bool), (source, target)), shape=(num_nodes, num_nodes))
    _, component = connected_components(adjacency, directed=False)
    _, roots = np.unique(component, return_index=True)
    return component.astype(np.int64), roots.astype(np.int64)
