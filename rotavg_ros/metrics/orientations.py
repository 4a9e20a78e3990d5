"""Errors of absolute orientations, and of relative ones."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

# An answer that is right or wrong all over takes 30 at most, one of two halves turned apart hundreds.
_MAX_ALIGNMENT_ITERATIONS = 1000
_SMOOTHING = np.radians(0.01)


def body_from_world(world_from_body: NDArray[np.floating]) -> Tensor:
    """Orientations ``(n, 4)`` xyzw as in messages and files, converted to the form that is compared here."""
    return rotations.inverse(torch.from_numpy(world_from_body))


def gauge_alignment(estimate: Tensor, truth: Tensor) -> Tensor:
    """The world rotation ``G`` ``(4,)`` with ``estimate ≈ truth · G``, fitted robustly (geodesic median, Weiszfeld).

    Args:
        estimate, truth: body_from_world ``(N, 4)``, N ≥ 1.
    """
    difference = rotations.multiply(rotations.inverse(truth), estimate)
    # The chordal mean, the dominant eigenvector of Σ q qᵀ, starts the iteration for the median.
    gauge = torch.linalg.eigh(difference.T @ difference).eigenvectors[:, -1]
    for _ in range(_MAX_ALIGNMENT_ITERATIONS):
        deviation = rotations.log(rotations.multiply(rotations.inverse(gauge), difference))
        weight = 1 / deviation.norm(dim=1, keepdim=True).clamp(min=_SMOOTHING)
        step = (weight * deviation).sum(0) / weight.sum()
        gauge = rotations.multiply(gauge, rotations.exp(step))
        if float(step.norm()) < 1e-9:
            break
    return rotations.normalize(gauge)


def orientation_errors(estimate: Tensor, truth: Tensor, component: Tensor | None = None) -> Tensor:
    """Angle of every orientation to the truth after one robust global rotation per component (the paper's metric).

    Args:
        estimate, truth: body_from_world ``(N, 4)``; rows of NaN in ``truth`` are unknown.
        component: ``(N,)`` int64; default one component.

    Returns:
        ``(N,)`` radians, NaN where the truth is unknown.
    """
    estimate, truth = estimate.double(), truth.double()
    errors = torch.full((len(estimate),), torch.nan, dtype=torch.float64)
    known = torch.isfinite(truth).all(dim=1)
    component = torch.zeros(len(estimate), dtype=torch.int64) if component is None else component
    for number in torch.unique(component[known]).tolist():
        members = known & (component == number)
        gauge = gauge_alignment(estimate[members], truth[members])
        aligned = rotations.multiply(truth[members], gauge)
        errors[members] = rotations.angle_between(estimate[members], aligned)
    return errors


def true_edge_noise(graph: ViewGraph, truth: Tensor) -> Tensor:
    """Angle between every edge's relative rotation and the one that follows from orientations.

    Args:
        graph: of N nodes and M edges.
        truth: body_from_world ``(N, 4)``; edges of nodes in NaN rows are unknown.

    Returns:
        ``(M,)`` radians, NaN where unknown.
    """
    true_relative = rotations.multiply(truth[graph.target], rotations.inverse(truth[graph.source]))
    return rotations.angle_between(graph.target_from_source, true_relative)
