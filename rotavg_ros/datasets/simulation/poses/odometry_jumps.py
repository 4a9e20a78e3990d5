"""Odometry whose position jumps while its heading does not: spinning wheels, a tracker that lost track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.datasets.simulation.poses.drawn import DrawnPoses, IndexArray

# Size of a jump in median steps of the odometry; and share of the path at either end without jumps, since there may be
# no closures to judge them there.
STEPS = (3.0, 40.0)
_ENDS = 0.1
_TRIES = 400


def with_jumps(drawn: DrawnPoses, count: int, rng: np.random.Generator) -> DrawnPoses:
    """Let ``count`` odometry steps jump, each in a random direction; without them, good closures still join the graph.

    Raises:
        ValueError: fewer steps than jumps, or too few steps without which closures still join the graph.
    """
    odometry = np.flatnonzero(drawn.graph.is_odometry.numpy())
    kept = int(_ENDS * len(odometry))
    for _ in range(_TRIES):
        steps = rng.choice(odometry[kept : len(odometry) - kept], count, replace=False)
        if _holds_without(drawn, steps):
            break
    else:
        raise ValueError("hardly a step of the odometry that closures hold together without")
    assert drawn.graph.translation is not None
    translation = drawn.graph.translation.clone()
    typical = float(np.median(np.linalg.norm(translation[odometry].numpy(), axis=1)))
    direction = rng.normal(size=(count, 3)) * [1, 1, not drawn.poses.planar]
    length = typical * rng.uniform(*STEPS, count) / np.linalg.norm(direction, axis=1)
    translation[steps] += torch.from_numpy(direction * length[:, None])
    is_wrong = drawn.is_wrong.copy()
    is_wrong[steps] = True
    return replace(drawn, graph=replace(drawn.graph, translation=translation), is_wrong=is_wrong)


def _holds_without(drawn: DrawnPoses, steps: IndexArray) -> bool:
    used = ~drawn.is_wrong
    used[steps] = False
    ends = drawn.graph.source.numpy()[used], drawn.graph.target.numpy()[used]
    links = coo_array((np.ones(len(ends[0])), ends), shape=(drawn.graph.num_nodes,) * 2)
    return bool(connected_components(links, directed=False)[0] == 1)
