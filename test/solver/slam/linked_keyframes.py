"""Graphs with an edge from each keyframe to some shortly after it, beside loop closures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.rotations import inverse
from rotavg_ros.solver import Solution
from rotavg_ros.view_graph import ViewGraph

SPANS = (2, 3, 4)


@cache
def drawn(kind: str, seed: int = 0) -> DrawnGraph:
    return next(one for one in KINDS if one.name == kind).drawn(seed)


def poses(graph: ViewGraph) -> tuple[Rotation, np.ndarray]:
    """World-from-body orientations and positions along odometry, whose edges join each keyframe to the next."""
    steps = graph.is_odometry.nonzero()[:, 0]
    steps = steps[torch.argsort(graph.target[steps])]
    turn = Rotation.from_quat(inverse(graph.target_from_source[steps]).numpy())
    assert graph.translation is not None
    shift = graph.translation[steps].numpy()
    orientation, position = [Rotation.identity()], [np.zeros(3)]
    for number in range(len(steps)):
        position.append(position[-1] + orientation[-1].apply(shift[number]))
        orientation.append(orientation[-1] * turn[number])
    return Rotation.concatenate(orientation), np.array(position)


def linked(
    case: DrawnGraph, own_deg: float = 0.0, *, by_truth: bool = False, spans: tuple[int, ...] = SPANS, seed: int = 0
) -> ViewGraph:
    """The graph, with translations, and an edge from each keyframe to some shortly after it.

    Args:
        case: the graph without them.
        own_deg: these edges' own errors, degrees and, per degree, 5 cm.
        by_truth: they are measured; otherwise made of odometry.
        spans: how many keyframes after.
        seed: of their errors.
    """
    graph = replace(case.graph, translation=torch.from_numpy(case.edge_translation))
    if by_truth:
        orientation, position = Rotation.from_quat(case.body_from_world).inv(), case.position
    else:
        orientation, position = poses(graph)
    count, rng = graph.num_nodes, np.random.default_rng(seed)
    source = np.concatenate([np.arange(count - span) for span in spans])
    target = np.concatenate([np.arange(span, count) for span in spans])
    turn = orientation[source].inv() * orientation[target]
    axes = np.array([0.0, 0.0, 1.0]) if case.planar else np.ones(3)
    turn = turn * Rotation.from_rotvec(np.radians(own_deg) * axes * rng.normal(size=(len(source), 3)))
    shift = orientation[source].inv().apply(position[target] - position[source])
    shift += 0.05 * own_deg * (1 - axes if case.planar else axes) * rng.normal(size=shift.shape)
    more = ViewGraph.create(
        source, target, source_from_target=turn.as_quat(), translation=shift, num_nodes=graph.num_nodes
    )
    columns = ("source", "target", "target_from_source", "kind", "precision", "label", "steps", "translation")
    return replace(graph, **{name: torch.cat((getattr(graph, name), getattr(more, name))) for name in columns})


def error_deg(case: DrawnGraph, solution: Solution) -> float:
    return float(
        torch.rad2deg(orientation_errors(solution.body_from_world, torch.from_numpy(case.body_from_world))).mean()
    )
