"""Errors that loop closures have in common.

A real front end that matches the same two stretches of the path ten times sees the same view ten times and errs ten
times in the same way. Taken for independent, such a run of closures overrules the odometry. Whether a graph is like
that shows in its residuals: within a run they scatter less than the estimated noise says.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.slam.graph.agreement import AgreementPairs

# Closures whose ends are at most this many odometry steps apart, both ends summed, belong to one run.
RUN_GAP_STEPS = 30
# Scatter worth this many observations speaks for independent errors.
_PRIOR_OBSERVATIONS = 5.0
_MAX_SHARE = 0.9
# No view lasts longer than this many odometry steps, or closures, however closely they follow each other.
_STRETCH_STEPS = 60
_MAX_RUN = 25.0


def closure_runs(pairs: AgreementPairs, good: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Number of the run of each closure, ``(C,)``.

    Closures link up with near ones; a chain of links is cut where it leaves a stretch of the odometry, since a robot on
    its second lap sees another view after a while.

    Args:
        pairs: neighbouring closures.
        good: ``(C,)`` bool; others are runs of their own.
        position: ``(C,)`` odometry steps to the closure's older end.
    """
    linked = (pairs.steps <= RUN_GAP_STEPS) & good[pairs.first] & good[pairs.second]
    links = coo_array(
        (np.ones(int(linked.sum())), (pairs.first[linked], pairs.second[linked])), shape=(len(good), len(good))
    )
    chain = connected_components(links, directed=False)[1]
    stretch = np.stack((chain, position // _STRETCH_STEPS), axis=1)
    return np.asarray(np.unique(stretch, axis=0, return_inverse=True)[1]).reshape(-1)


class RunErrors(NamedTuple):
    """How the closures of a graph err (C closures, k samples).

    Attributes:
        run: ``(C,)`` of :func:`closure_runs`.
        inlier_probability: ``(C,)``.
        residual: ``(C, 3)`` rad, all from older to newer end.
        own_steps: ``(C,)`` variance of each closure's own noise in units of that of all.
        samples: ``(C, k)`` differences of the fit's samples over the closures, in the same direction.
    """

    run: np.ndarray
    inlier_probability: np.ndarray
    residual: np.ndarray
    own_steps: np.ndarray
    samples: np.ndarray


def common_share(errors: RunErrors, closure_variance: float, components: int) -> float:
    """Share of the closures' error variance that a run has in common, in [0, 0.9].

    Analysis of variance: independent errors of variance σ² leave residuals that scatter within a run by σ² (n − 1) less
    what the fit takes up, which samples of the fit tell.

    Args:
        closure_variance: σ², rad².
        components: 1 for planar graphs, else 3.
    """
    run, samples = errors.run, errors.samples
    size = np.bincount(run, errors.inlier_probability)
    weight = errors.inlier_probability / errors.own_steps
    total = np.maximum(np.bincount(run, weight), 1e-9)

    def scatter(values: np.ndarray) -> float:
        mean = np.stack([np.bincount(run, weight * column) / total for column in values.T], axis=1)
        return float((weight[:, None] * (values - mean[run]) ** 2).sum())

    observed = scatter(errors.residual) / components
    expected = closure_variance * np.maximum(size - 1, 0).sum() - scatter(samples) / samples.shape[1]
    prior = _PRIOR_OBSERVATIONS * closure_variance
    return float(np.clip(1 - (observed + prior) / (max(expected, 0.0) + prior), 0.0, _MAX_SHARE))


def variance_factor(run: np.ndarray, inlier_probability: np.ndarray, share: float) -> np.ndarray:
    """``(C,)`` by how much to inflate each closure's variance so that a run of n weighs what its mean is worth."""
    size = np.clip(np.bincount(run, inlier_probability)[run], 1.0, _MAX_RUN)
    return np.asarray((1 - share) + share * size)
