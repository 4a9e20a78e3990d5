"""Measured closures over few keyframes: odometry that spans several steps.

Many front ends match each keyframe with several before it (VINS, the covisibility edges of ORB-SLAM, scan matchers).
Such a link errs about as odometry does, not as a loop closure, which is taken from another place at another time. With
one variance for both, loop closures would be believed far too much. So links that agree with odometry between their
ends are odometry beside the chain; its variance relative to the chain's is estimated. Links that do not agree stay
closures: they may be false, or odometry may have slipped below them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.slam.graph.odometry_paths import OdometryPaths, odometry_forest
from rotavg_ros.solver.slam.noise.restated_odometry import LOOP_STEPS, is_of_its_kind, restated_odometry
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

# Links are odometry if there are as many as other closures, and at least so many.
_LEAST_LINKS = 100


def with_links(graph: ViewGraph) -> tuple[ViewGraph, np.ndarray]:
    """The graph with links as odometry, and ``(n,)`` these edges; none unless links are most of all closures.

    An edge over k steps has k times the variance of a step, times the factor of all odometry beside the chain.
    """
    if int((~graph.is_odometry).sum()) < _LEAST_LINKS:
        return graph, np.zeros(0, dtype=np.int64)
    short = _Short.of(graph)
    others = int((~graph.is_odometry).sum()) - len(short.edge)
    if len(short.edge) < max(_LEAST_LINKS, others):
        return graph, np.zeros(0, dtype=np.int64)
    return short.as_odometry(graph, np.zeros(0, dtype=np.int64), 0)


def with_more_links(graph: ViewGraph, links: np.ndarray, known: int) -> tuple[ViewGraph, np.ndarray]:
    """The same for a graph that has grown: new closures are links if they agree with odometry as known links do.

    Args:
        graph: N nodes, M edges.
        links: ``(n,)`` edges that are odometry in it already.
        known: number of edges that it had before; older closures stay closures.
    """
    if len(links) == 0 or graph.num_edges == known:
        return graph, links
    return _Short.of(graph, links).as_odometry(graph, links, known)


def as_odometry(graph: ViewGraph, links: np.ndarray, steps: np.ndarray) -> ViewGraph:
    """The graph in which edges ``(n,)`` are odometry over ``steps`` ``(n,)``."""
    kind, passed = graph.kind.clone(), graph.steps.clone()
    kind[links], passed[links] = EdgeKind.ODOMETRY, torch.from_numpy(steps)
    return replace(graph, kind=kind, steps=passed)


def as_closures(graph: ViewGraph, links: np.ndarray) -> ViewGraph:
    """The graph in which edges ``(n,)`` are the closures that they were."""
    kind, passed = graph.kind.clone(), graph.steps.clone()
    kind[links], passed[links] = EdgeKind.LOOP_CLOSURE, 1.0
    return replace(graph, kind=kind, steps=passed)


class _Short(NamedTuple):
    """n edges beside the chain over few keyframes, neither made of odometry nor rejected.

    Attributes:
        edge: ``(n,)``.
        steps: ``(n,)`` odometry steps between their ends.
        agrees: ``(n,)`` bool, whether they differ from odometry by no more than is usual per step.
    """

    edge: np.ndarray
    steps: np.ndarray
    agrees: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph, links: Sequence[int] | np.ndarray = ()) -> _Short:
        """Closures, and edges that are links already."""
        paths = OdometryPaths.along(graph, odometry_forest(graph))
        outside = paths.outside
        chosen = np.isin(outside, links) | ~graph.is_odometry.numpy()[outside]
        chosen &= (paths.path_steps <= LOOP_STEPS) & ~restated_odometry(graph, paths)[outside]
        chosen &= graph.label.numpy()[outside] != EdgeLabel.REJECTED
        edge, steps = outside[chosen], paths.path_steps[chosen]
        turned = (rotations.log(paths.residual).numpy()[chosen] ** 2).sum(axis=1)
        shifted = _shifted(graph, paths, edge)
        agrees = is_of_its_kind(turned / steps, graph.rotation_components)
        if shifted is not None:
            agrees &= np.isnan(shifted) | is_of_its_kind(shifted / steps, 3)
        return cls(edge, steps, agrees)

    def as_odometry(self, graph: ViewGraph, links: np.ndarray, known: int) -> tuple[ViewGraph, np.ndarray]:
        """The graph in which those from edge ``known`` on that agree are odometry, and ``(n,)`` these and ``links``."""
        more = np.flatnonzero(self.agrees & (self.edge >= known))
        more = more[np.argsort(self.edge[more])]
        return as_odometry(graph, self.edge[more], self.steps[more]), np.concatenate((links, self.edge[more]))


def _shifted(graph: ViewGraph, paths: OdometryPaths, edge: np.ndarray) -> np.ndarray | None:
    """``(n,)`` m², squared discrepancies of edges' translations with odometry's; NaN where unknown. None without any.

    Where odometry states no translations, those of closures say nothing.
    """
    if graph.translation is None:
        return None
    world_from_body = rotations.inverse(paths.orientation)
    shift = rotations.rotate(world_from_body[graph.source], graph.translation.double()).numpy()
    forest = paths.forest
    child = np.flatnonzero(paths.hangs_on_odometry)
    by = forest.parent_edge[child]
    if not np.isfinite(shift[by]).all():
        return None
    step = np.zeros((graph.num_nodes, 3))
    step[child] = np.where((graph.target.numpy()[by] == child)[:, None], shift[by], -shift[by])
    position = np.stack([accumulate_to_root(forest, column) for column in step.T], axis=1)
    between = position[graph.target.numpy()[edge]] - position[graph.source.numpy()[edge]]
    return np.asarray(((shift[edge] - between) ** 2).sum(axis=1))
