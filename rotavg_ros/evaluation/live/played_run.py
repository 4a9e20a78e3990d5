"""How good a node's answer on a played bag is, compared with odometry and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.evaluation.live.node_answer import NodeAnswer
from rotavg_ros.metrics import (
    OutlierCounts,
    body_from_world,
    gauge_alignment,
    known_rows,
    orientation_errors,
    true_edge_noise,
)
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG, FALSE_CLOSURE_M, EdgeKind, ViewGraph

FloatArray = NDArray[np.floating]

_FALSE_CLOSURE_RAD = np.radians(FALSE_CLOSURE_DEG)


@dataclass(frozen=True)
class PlayedRun:
    """What is known about a bag that was played (N poses, M edges with the ids 0 … M-1 that the bag gave them).

    Attributes:
        ids: ``(N,)`` keyframe ids if the bag's edges name keyframes by id; None if they name them by stamp.
        stamps_ns: ``(N,)`` int64.
        odometry_world_from_body, odometry_position: ``(N, 4)`` xyzw and ``(N, 3)`` metres, drifting.
        true_world_from_body, true_position: the same, true; NaN rows where unknown; None if all are.
        edge_is_false: ``(M,)`` 1 or 0, NaN where unknown; odometry edges are never counted.
    """

    ids: NDArray[np.int64] | None
    stamps_ns: NDArray[np.int64]
    odometry_world_from_body: FloatArray
    odometry_position: FloatArray
    true_world_from_body: FloatArray | None
    true_position: FloatArray | None
    edge_is_false: FloatArray


def edge_is_false(
    graph: ViewGraph, true_body_from_world: FloatArray | None, true_position: FloatArray | None = None
) -> FloatArray:
    """``(M,)`` 1 where an edge's rotation errs by more than 10° or its translation by more than 2 m, 0 where not.

    NaN where the truth is unknown. Without a translation, or true positions at all, the rotation alone is judged.
    """
    if true_body_from_world is None:
        return np.full(graph.num_edges, np.nan)
    truth = torch.from_numpy(true_body_from_world)
    noise = true_edge_noise(graph, truth).numpy()
    is_turned = np.where(np.isnan(noise), np.nan, noise > _FALSE_CLOSURE_RAD)
    if graph.translation is None or true_position is None:
        return is_turned
    position = torch.from_numpy(true_position)
    shift = rotations.rotate(truth[graph.source], position[graph.target] - position[graph.source])
    off = (shift - graph.translation).norm(dim=1).numpy()
    is_elsewhere = np.where(np.isnan(off), np.nan, off > FALSE_CLOSURE_M)
    judged = np.where(is_turned == 1, 1.0, np.maximum(is_turned, is_elsewhere))
    return np.where(graph.translation.isfinite().all(dim=1).numpy(), judged, is_turned)


@dataclass(frozen=True)
class LiveReport:
    """A node's answer in the frame of the truth (of odometry, where there is none), and how good it is (K keyframes).

    Attributes:
        seconds: ``(K,)`` time since the start.
        true_position: ``(K, 3)``, NaN rows where unknown.
        odometry_position, corrected_position: ``(K, 3)``; corrected: odometry's steps along corrected orientations.
        odometry_error, corrected_error: ``(K,)`` radians, NaN where unknown.
        closure_ends: ``(C, 2)`` indices of the keyframes that each loop closure connects.
        closure_score, closure_flagged: ``(C,)``.
        closure_is_false: ``(C,)`` 1, 0, or NaN where unknown.
        verdicts: counts over all closures of the bag, where those that the node never reported count as unflagged;
            None if the truth is unknown.
        diagnostics: the node's own.
    """

    seconds: FloatArray
    true_position: FloatArray
    odometry_position: FloatArray
    corrected_position: FloatArray
    odometry_error: FloatArray
    corrected_error: FloatArray
    closure_ends: NDArray[np.int64]
    closure_score: FloatArray
    closure_flagged: NDArray[np.bool_]
    closure_is_false: FloatArray
    verdicts: OutlierCounts | None
    diagnostics: dict[str, str]

    @property
    def knows_errors(self) -> bool:
        return bool(np.isfinite(self.corrected_error).any())


def judge(answer: NodeAnswer, run: PlayedRun, is_closure: NDArray[np.bool_]) -> LiveReport:
    """Compare a node's answer with what is known about the run.

    Args:
        is_closure: ``(M,)`` which of the run's edges are loop closures.
    """
    pose = _pose_of_keyframes(answer, run)
    unknown = np.full((len(pose), 4), np.nan)
    truth = unknown if run.true_world_from_body is None else run.true_world_from_body[pose]
    odometry = run.odometry_world_from_body[pose]
    steps = _steps(run.odometry_position[pose], odometry)
    true_position = unknown[:, :3] if run.true_position is None else run.true_position[pose]

    known = known_rows(truth)
    start = int(np.argmax(known)) if known.any() else 0
    # Odometry is shown as the robot believed it from its first known pose on; the answer is fitted as a whole.
    frame = truth[start] if known.any() else odometry[0]
    odometry_turn = Rotation.from_quat(frame) * Rotation.from_quat(odometry[start]).inv()
    if known.any():
        first = answer.component == answer.component[start]
        gauge = gauge_alignment(
            body_from_world(answer.world_from_body[known & first]), body_from_world(truth[known & first])
        )
        corrected_turn = Rotation.from_quat(gauge.numpy())
    else:
        corrected_turn = Rotation.from_quat(odometry[0]) * Rotation.from_quat(answer.world_from_body[0]).inv()
    corrected_position = _walk(corrected_turn * Rotation.from_quat(answer.world_from_body), steps)
    odometry_position = _walk(odometry_turn * Rotation.from_quat(odometry), steps)
    anchored = known_rows(true_position)
    if anchored.any():
        odometry_position += true_position[anchored][0] - odometry_position[anchored][0]
        corrected_position += (true_position - corrected_position)[anchored].mean(axis=0)

    closures = np.flatnonzero(answer.kind == EdgeKind.LOOP_CLOSURE)
    edge = answer.edge_ids[closures].astype(np.int64)
    row_of = {int(number): row for row, number in enumerate(answer.keyframe_ids)}
    ends = np.array(
        [(row_of[int(answer.source_ids[c])], row_of[int(answer.target_ids[c])]) for c in closures], dtype=np.int64
    ).reshape(-1, 2)
    return LiveReport(
        seconds=(run.stamps_ns[pose] - run.stamps_ns[0]) / 1e9,
        true_position=true_position,
        odometry_position=odometry_position,
        corrected_position=corrected_position,
        odometry_error=_errors(odometry, truth, answer.component),
        corrected_error=_errors(answer.world_from_body, truth, answer.component),
        closure_ends=ends,
        closure_score=answer.score[closures],
        closure_flagged=answer.is_outlier[closures],
        closure_is_false=run.edge_is_false[edge],
        verdicts=_verdicts(edge[answer.is_outlier[closures]], run.edge_is_false, is_closure),
        diagnostics=answer.diagnostics,
    )


def _pose_of_keyframes(answer: NodeAnswer, run: PlayedRun) -> NDArray[np.int64]:
    """The run's pose of every keyframe: by id, or the nearest by stamp."""
    if run.ids is not None:
        return np.searchsorted(run.ids, answer.keyframe_ids.astype(np.int64))
    after = np.clip(np.searchsorted(run.stamps_ns, answer.stamps_ns), 1, len(run.stamps_ns) - 1)
    before_is_nearer = answer.stamps_ns - run.stamps_ns[after - 1] < run.stamps_ns[after] - answer.stamps_ns
    return np.asarray(after - before_is_nearer)


def _verdicts(
    flagged_edges: NDArray[np.int64], is_false: FloatArray, is_closure: NDArray[np.bool_]
) -> OutlierCounts | None:
    judged = is_closure & np.isfinite(is_false)
    if not judged.any():
        return None
    flagged = np.zeros(len(is_false), dtype=bool)
    flagged[flagged_edges] = True
    return OutlierCounts.of(torch.from_numpy(flagged[judged]), torch.from_numpy(is_false[judged] > 0.5))


def _steps(position: FloatArray, world_from_body: FloatArray) -> FloatArray:
    """Displacement from each pose to the next in its body frame, ``(K-1, 3)``."""
    moves = np.diff(position, axis=0)
    return np.asarray(Rotation.from_quat(world_from_body[:-1]).inv().apply(moves)).reshape(-1, 3)


def _walk(world_from_body: Rotation, steps: FloatArray) -> FloatArray:
    """Positions from displacements in the body frame; starts at the origin."""
    moves = world_from_body[:-1].apply(steps).reshape(-1, 3)
    return np.concatenate((np.zeros((1, 3)), np.cumsum(moves, axis=0)))


def _errors(estimate: FloatArray, truth: FloatArray, component: NDArray[np.int64] | None = None) -> FloatArray:
    components = None if component is None else torch.from_numpy(component)
    return orientation_errors(body_from_world(estimate), body_from_world(truth), components).numpy()
