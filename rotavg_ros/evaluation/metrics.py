"""Errors of absolute orientations and of outlier verdicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations

_ALIGNMENT_ITERATIONS = 30
_SMOOTHING = np.radians(0.01)


def gauge_alignment(estimate: Tensor, truth: Tensor) -> Tensor:
    """The world rotation ``G`` ``(4,)`` with ``estimate ≈ truth · G``, fitted robustly (geodesic median, Weiszfeld).

    Args:
        estimate, truth: body_from_world ``(N, 4)``, N ≥ 1.
    """
    difference = rotations.multiply(rotations.inverse(truth), estimate)
    # The chordal mean, the dominant eigenvector of Σ q qᵀ, starts the iteration for the median.
    gauge = torch.linalg.eigh(difference.T @ difference).eigenvectors[:, -1]
    for _ in range(_ALIGNMENT_ITERATIONS):
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


@dataclass(frozen=True)
class OutlierCounts:
    """How verdicts on edges compare with the truth."""

    true_positives: int
    false_positives: int
    false_negatives: int
    true_negatives: int

    @classmethod
    def of(cls, flagged: Tensor, is_outlier: Tensor) -> OutlierCounts:
        """Both ``(M,)`` bool."""
        return cls(
            int((flagged & is_outlier).sum()),
            int((flagged & ~is_outlier).sum()),
            int((~flagged & is_outlier).sum()),
            int((~flagged & ~is_outlier).sum()),
        )

    @property
    def precision(self) -> float:
        """Share of the flagged edges that are outliers; 1 if none is flagged."""
        flagged = self.true_positives + self.false_positives
        return self.true_positives / flagged if flagged else 1.0

    @property
    def recall(self) -> float:
        """Share of the outliers that are flagged; 1 if there is none."""
        outliers = self.true_positives + self.false_negatives
        return self.true_positives / outliers if outliers else 1.0

    @property
    def accuracy(self) -> float:
        total = self.true_positives + self.false_positives + self.false_negatives + self.true_negatives
        return (self.true_positives + self.true_negatives) / total if total else 1.0


def true_edge_noise(graph_target_from_source: Tensor, source: Tensor, target: Tensor, truth: Tensor) -> Tensor:
    """Angle between every measured relative rotation and the true one, ``(M,)`` rad; NaN where unknown."""
    true_relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    return rotations.angle_between(graph_target_from_source, true_relative)
