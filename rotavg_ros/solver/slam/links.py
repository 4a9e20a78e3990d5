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
from rotavg_ros.solver.slam.graph.odometry_paths import (
    LOOP_STEPS,
    OdometryPaths,
    near_a_branch,
    odometry_ends,
    odometry_forest,
)
from rotavg_ros.solver.slam.hung_nodes import hung
from rotavg_ros.solver.slam.noise.exceedance import OUTLIER_ANGLE
from rotavg_ros.solver.slam.noise.restated_odometry import is_of_its_kind, restated_odometry
from rotavg_ros.view_graph import FALSE_CLOSURE_M, EdgeKind, EdgeLabel, ViewGraph

# Links are odometry if there are as many as other closures, and at least so many, of which so large a share agrees with
# odometry. Where more are false they are judged like any closure: false ones would decide what is usual.
_LEAST_LINKS, _AGREEING = 100, 0.75
# Steps of the edge by which a submap hangs on odometry; more than one, so that no chain is led over it.
_HANG_STEPS = 2.0


def with_links(graph: ViewGraph) -> tuple[ViewGraph, np.ndarray]:
    """The graph with links as odometry, and ``(n,)`` these edges; none unless links are most of all closures.

    An edge over k steps has k times the variance of a step, times the factor of all odometry beside the chain.
    """
    if int((~graph.is_odometry).sum()) < _LEAST_LINKS:
        return graph, np.zeros(0, dtype=np.int64)
    graph, links = _with_hung(graph)
    short = _Short.of(graph)
    if len(short.edge) < max(_LEAST_LINKS, short.others) or short.agrees.mean() < _AGREEING:
        return graph, links
    return short.as_odometry(graph, links, 0)


def _with_hung(graph: ViewGraph, *, some_do: bool = False) -> tuple[ViewGraph, np.ndarray]:
    """The graph with submaps on odometry, and the edges by which they hang on it; none unless these are made of it."""
    edge = hung(graph, some_do=some_do)
    if len(edge) == 0:
        return graph, edge
    tried = as_odometry(graph, edge, np.full(len(edge), _HANG_STEPS))
    paths = OdometryPaths.along(tried, odometry_forest(tried))
    beside = paths.outside[near_a_branch(tried, paths) >= 0]
    if len(beside) == 0 or restated_odometry(tried, paths)[beside].mean() < _AGREEING:
        return graph, np.zeros(0, dtype=np.int64)
    return tried, edge


def with_more_links(graph: ViewGraph, links: np.ndarray, known: int) -> tuple[ViewGraph, np.ndarray]:
    """The same for a graph that has grown: new closures are links if they agree with odometry as known links do.

    Args:
        graph: N nodes, M edges.
        links: ``(n,)`` edges that are odometry in it already.
        known: number of edges that it had before; older closures stay closures.
    """
    if len(links) == 0 or graph.num_edges == known:
        return graph, links
    ends = odometry_ends(graph)
    graph, more = _with_hung(graph, some_do=bool(ends[torch.stack((graph.source, graph.target))[:, links]].any()))
    links = np.concatenate((links, more))
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
        agrees: ``(n,)`` bool, whether they differ from odometry by no more than is usual per step; none does
            where most differ by what would make a closure false.
        others: number of other closures that are neither.
    """

    edge: np.ndarray
    steps: np.ndarray
    agrees: np.ndarray
    others: int

    @classmethod
    def of(cls, graph: ViewGraph, links: Sequence[int] | np.ndarray = ()) -> _Short:
        """Closures, and edges that are links already."""
        paths = OdometryPaths.along(graph, odometry_forest(graph))
        outside = paths.outside
        chosen = np.isin(outside, links) | ~graph.is_odometry.numpy()[outside]
        chosen &= ~restated_odometry(graph, paths)[outside] & (graph.label.numpy()[outside] != EdgeLabel.REJECTED)
        is_short = (paths.path_steps <= LOOP_STEPS) | (near_a_branch(graph, paths) >= 0)
        others = int((chosen & ~is_short).sum())
        chosen &= is_short
        edge, steps = outside[chosen], paths.path_steps[chosen]
        turned = (rotations.log(paths.residual).numpy()[chosen] ** 2).sum(axis=1)
        shifted = _shifted(graph, paths, edge)
        agrees = is_of_its_kind(turned / steps, graph.rotation_components) & _mostly_below(turned, OUTLIER_ANGLE)
        if shifted is not None:
            known = ~np.isnan(shifted)
            usual = is_of_its_kind(shifted / steps, 3) & _mostly_below(shifted[known], FALSE_CLOSURE_M)
            agrees &= ~known | usual
        return cls(edge, steps, agrees, others)

    def as_odometry(self, graph: ViewGraph, links: np.ndarray, known: int) -> tuple[ViewGraph, np.ndarray]:
        """The graph in which those from edge ``known`` on that agree are odometry, and ``(n,)`` these and ``links``."""
        more = np.flatnonzero(self.agrees & (self.edge >= known))
        more = more[np.argsort(self.edge[more])]
        return as_odometry(graph, self.edge[more], self.steps[more]), np.concatenate((links, self.edge[more]))


def _mostly_below(square: np.ndarray, most: float) -> bool:
    return len(square) == 0 or bool(np.median(square) < most**2)


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
    with np.errstate(over="ignore"):  # a closure may state any translation
        return np.asarray(((shift[edge] - between) ** 2).sum(axis=1))
