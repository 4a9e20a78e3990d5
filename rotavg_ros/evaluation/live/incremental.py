"""A pose graph as on a robot: edges in time order, an answer every few keyframes, each judged as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.baselines.start import start_orientations
from rotavg_ros.evaluation.common.cases import Case
from rotavg_ros.evaluation.live.feed import Feed
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.online.estimator import OnlineEstimator
from rotavg_ros.online.options import EstimatorOptions

KEYFRAMES_PER_TICK = 10
# Before this many keyframes, errors mean little and closures are too few for a correction.
SETTLED_KEYFRAMES = 2000


@dataclass(frozen=True)
class IncrementalRun:
    """The results of every tick (T ticks).

    Attributes:
        case: the case that was played.
        keyframes: ``(T,)`` number of keyframes.
        error_deg, odometry_error_deg: ``(T,)`` mean error of all keyframes so far, of the answer and of odometry
            alone; NaN before the first keyframe of known orientation.
        flips: ``(T,)`` closures whose flag changed since the tick before.
        false_flagged, good_flagged, false_seen, good_seen: ``(T,)`` counts of closures so far.
        jump_deg: ``(T,)`` largest turn of a keyframe that the tick before knew, too.
        seconds, after_seconds: ``(T,)`` of every tick, until its answer and of the work that goes on after it.
    """

    case: Case
    keyframes: np.ndarray
    error_deg: np.ndarray
    odometry_error_deg: np.ndarray
    flips: np.ndarray
    false_flagged: np.ndarray
    good_flagged: np.ndarray
    false_seen: np.ndarray
    good_seen: np.ndarray
    jump_deg: np.ndarray
    seconds: np.ndarray
    after_seconds: np.ndarray

    @property
    def worst_excess_deg(self) -> float:
        """Largest excess of an answer's error over that of odometry alone, after the first 2000 keyframes."""
        excess = (self.error_deg - self.odometry_error_deg)[self.keyframes > SETTLED_KEYFRAMES]
        excess = excess[np.isfinite(excess)]
        return float(excess.max()) if len(excess) else float("nan")


def play(
    case: Case,
    options: EstimatorOptions | None = None,
    watch: Callable[[Iterable[int]], Iterable[int]] = lambda ticks: ticks,
) -> IncrementalRun:
    """Give the edges of a case to the estimator, each when its later end exists, and tick every 10 keyframes.

    Args:
        options: of the estimator; its keyframes come from the edges.
        watch: passes the ticks through and may show how far they are.
    """
    graph = case.graph
    is_closure, is_false, is_good = (mask.numpy() for mask in (case.is_closure, case.is_false, case.is_good))
    options = options or EstimatorOptions(keyframe_source="edges", gauge="identity")
    estimator = OnlineEstimator(options)
    feed = Feed(graph, estimator)
    arrival, odometry = feed.arrival, start_orientations(graph, None)[0]
    flags, orientations = np.zeros(graph.num_edges, dtype=bool), rotations.identity(0)
    rows = []
    ends = [*range(KEYFRAMES_PER_TICK, graph.num_nodes, KEYFRAMES_PER_TICK), graph.num_nodes]
    for end in watch(ends):
        feed.until(end)
        answer = estimator.tick()
        answered = time.perf_counter()
        estimator.go_on()
        after_seconds = time.perf_counter() - answered
        if answer is None:
            continue
        node = torch.from_numpy(answer.keyframe_id.astype(np.int64))
        now = rotations.identity(end)
        now[node] = rotations.inverse(torch.from_numpy(answer.world_from_body))
        known = min(len(orientations), end)
        turned = rotations.angle_between(now[:known], orientations[:known])
        edges = answer.edge_id.astype(np.int64)
        closures = edges[is_closure[edges]]
        before = flags.copy()
        # If only the truth of rotations is known, verdicts on places do not count.
        rotation_score = answer.rotation_score if case.poses is None else None
        flags[edges] = answer.outlier if rotation_score is None else rotation_score > options.outlier_threshold
        is_old = arrival[closures] < len(orientations)
        rows.append(
            (
                end,
                _mean_error_deg(now, case, end),
                _mean_error_deg(odometry[:end], case, end),
                int((flags != before)[closures[is_old]].sum()),
                int((flags & is_false)[closures].sum()),
                int((flags & is_good)[closures].sum()),
                int(is_false[closures].sum()),
                int(is_good[closures].sum()),
                float(torch.rad2deg(turned.max())) if known else 0.0,
                answer.seconds,
                after_seconds,
            )
        )
        orientations = now
    return IncrementalRun(case, *np.array(rows).T)


def _mean_error_deg(estimate: torch.Tensor, case: Case, end: int) -> float:
    truth = case.truth[:end]
    known = torch.isfinite(truth).all(dim=1)
    if not bool(known.any()):
        return float("nan")
    return float(torch.rad2deg(orientation_errors(estimate[known], truth[known]).mean()))
