"""Robots, or stretches after a gap of odometry, that nothing joins to the rest but closures of one pair of places.

These closures may all be false by one mistake, and then agree with each other; nothing else could contradict them.
"""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.graph.chain_cuts import connected, joined_by_others
from rotavg_ros.solver.warnings.odometry import STRETCH, Odometry
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


def lone_places(odometry: Odometry, believed: ViewGraph) -> str | None:
    """Warns of parts of the map that closures of one pair of places alone join to the largest part.

    These have both ends within :data:`STRETCH` odometry edges, and within half of either part's length. Not if a user
    has accepted one of them.

    Args:
        odometry: of a graph of N nodes.
        believed: the same nodes, with the closures that the answer believes.
    """
    part = odometry.component.numpy()
    of_ends = part[np.stack((believed.source.numpy(), believed.target.numpy()))]
    joins = np.flatnonzero(of_ends[0] != of_ends[1])
    if len(joins) == 0:
        return None
    count = int(part.max()) + 1
    order = np.argsort(of_ends[:, joins], axis=0)
    ends = np.take_along_axis(of_ends[:, joins], order, axis=0)
    level = odometry.level().numpy()
    along = level[np.stack((believed.source.numpy()[joins], believed.target.numpy()[joins]))]
    along = np.take_along_axis(along, order, axis=0)
    pair, of_pair, number = np.unique(ends.T, axis=0, return_inverse=True, return_counts=True)
    is_accepted = (believed.label == EdgeLabel.ACCEPTED).numpy()[joins]
    is_one_place = np.bincount(of_pair, is_accepted) == 0
    # What is seen along most of a robot's way is not one place, however short that is.
    farthest = np.zeros(count)
    np.maximum.at(farthest, part, level)
    for of_end, of_parts in zip(along, pair.T, strict=True):
        is_one_place &= _spread(of_end, of_pair) <= np.minimum(STRETCH, farthest[of_parts] / 2)
    # Pairs that more than one place joins count twice, so neither joins alone.
    others = np.concatenate((pair, pair[~is_one_place]))
    is_lone = ~joined_by_others(count, others)[: len(pair)]
    if not is_lone.any():
        return None
    # Of what the graph joins, the largest part is the rest.
    joined, held = connected(count, pair), connected(count, pair[~is_lone])
    size = np.bincount(held, np.bincount(part, minlength=count))
    largest = np.zeros(int(joined.max()) + 1)
    np.maximum.at(largest, joined, size[held])
    loose = int(np.bincount(part).sum() - largest.sum())
    closures = int(number[is_lone].sum())
    by = "1 loop closure" if closures == 1 else f"{closures} loop closures"
    parts = "" if is_lone.sum() == 1 else " for each part"
    return (
        f"{loose} of {len(part)} keyframes are joined to the rest by {by} alone, of a single pair of places{parts}, "
        "and nothing would contradict these if they were false: close a loop elsewhere between them, or check these "
        "and accept one"
    )


def _spread(along: np.ndarray, group: np.ndarray) -> np.ndarray:
    """``(G,)`` largest minus least of the values ``(n,)`` of each of G groups."""
    most, least = np.full(int(group.max()) + 1, -np.inf), np.full(int(group.max()) + 1, np.inf)
    np.maximum.at(most, group, along)
    np.minimum.at(least, group, along)
    return np.asarray(most - least)
