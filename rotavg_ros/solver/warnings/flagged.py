"""Signs in an answer that many of the measurements are wrong."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# The probability above which an edge counts as flagged.
FLAGGED = 0.5
# Minimum number of closures for a warning that more than half of them are flagged.
_MIN_CLOSURES = 4
# Half angles in rad: below the first, an edge states no rotation, up to rounding; if the others' median is above the
# second, no real measurement would. The last is the share of such edges that is reported.
_NO_ROTATION, _SOME_ROTATION, _SHARE_OF_NOTHING = 1e-9, 0.01, 0.05


def mostly_flagged(
    graph: ViewGraph, outlier_score: Tensor, rotation_score: Tensor | None = None, restated: Tensor | None = None
) -> tuple[str, ...]:
    """Warns if more than half of the loop closures (without odometry: of the edges) are flagged, labelled ones aside.

    Args:
        graph: on the CPU, M edges.
        outlier_score: ``(M,)``.
        rotation_score: ``(M,)`` likewise, for the rotations alone; None: places are not judged.
        restated: ``(n,)`` edges that were not judged, since they are made of others.
    """
    judged = ~graph.is_odometry & (graph.label == EdgeLabel.AUTOMATIC)
    if restated is not None:
        judged[restated] = False
    is_flagged = judged & (outlier_score > FLAGGED)
    closures, flagged = int(judged.sum()), int(is_flagged.sum())
    if closures < _MIN_CLOSURES or 2 * flagged <= closures:
        return ()
    by_place = 0 if rotation_score is None else int((is_flagged & (rotation_score <= FLAGGED)).sum())
    if 2 * by_place > flagged:
        return (
            f"{flagged} of {closures} loop closures are flagged as false, {by_place} of them only because they join "
            "wrong places; if translations are not in metres, or not in the frame of their edge's source, correct them "
            "or set translation_scale to none; if the odometry's position jumped somewhere, leave that edge out; "
            "otherwise the front end may match wrong places",
        )
    if not bool(graph.is_odometry.any()):
        return (
            f"{flagged} of {closures} edges are flagged as false; different places may look alike, or some rotations "
            "may be stated from target to source: compare some of these edges with the pictures by hand",
        )
    return (
        f"{flagged} of {closures} loop closures are flagged as false; the front end may match wrong places, or the "
        "direction, the sensor's mounting or the clock may be wrong for all of them: check that each edge's rotation "
        "is the target's orientation in the source's frame, and compare some closures with the odometry by hand",
    )


def accepted_far_off(graph: ViewGraph, body_from_world: Tensor, outlier_angle: float) -> tuple[str, ...]:
    """Warns of edges that the user has accepted, and that are more than ``outlier_angle`` rad off in the answer.

    Args:
        graph: on the CPU, N nodes.
        body_from_world: ``(N, 4)`` the answer.
    """
    accepted = graph.select_edges(graph.label == EdgeLabel.ACCEPTED)
    if accepted.num_edges == 0:
        return ()
    residual = edge_residual(body_from_world, accepted.target_from_source, accepted.source, accepted.target)
    angle = rotations.angle(residual)
    far = int((angle > outlier_angle).sum())
    if far == 0:
        return ()
    return (
        f"{far} of {accepted.num_edges} accepted edges are more than {math.degrees(outlier_angle):.0f}° off in the "
        f"answer, up to {math.degrees(float(angle.max())):.0f}°; they contradict each other, or the method does "
        "not keep to labels: check which of them are right",
    )


def stating_nothing(graph: ViewGraph) -> tuple[str, ...]:
    """Warns if many edges of a graph without odometry state exactly no rotation, as some front ends do on failure.

    Rigs of parallel cameras state this, too, but each only between a few cameras of its own.

    Args:
        graph: on the CPU, N nodes, M edges.
    """
    sine = graph.target_from_source[:, :3].norm(dim=1)
    is_identity = sine < _NO_ROTATION
    count = int(is_identity.sum())
    if bool(graph.is_odometry.any()) or count < _SHARE_OF_NOTHING * graph.num_edges or bool(is_identity.all()):
        return ()
    touched = torch.unique(torch.cat((graph.source[is_identity], graph.target[is_identity])))
    if count <= len(touched) or float(sine[~is_identity].median()) < _SOME_ROTATION:
        return ()
    return (
        f"{count} of {graph.num_edges} edges state exactly no rotation; they agree with each other, and so make "
        "orientations alike: if the front end writes such edges where it found no match, leave them out",
    )
