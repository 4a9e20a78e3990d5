"""The last answer of a node as plain arrays, however it was received."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class NodeAnswer:
    """What a node published last (K keyframes, M edges).

    Attributes:
        keyframe_ids: ``(K,)`` uint64.
        stamps_ns: ``(K,)`` int64, -1 where unknown.
        world_from_body: ``(K, 4)`` xyzw.
        component: ``(K,)`` int64.
        edge_ids: ``(M,)`` uint64, the senders' ids.
        source_ids, target_ids: ``(M,)`` uint64, keyframes of the edges' ends.
        kind: ``(M,)`` int64 :class:`rotavg_ros.view_graph.EdgeKind`.
        score: ``(M,)`` outlier scores.
        is_outlier: ``(M,)`` bool, the verdicts.
        diagnostics: the node's last report on itself.
        answers: how many answers came.
    """

    keyframe_ids: NDArray[np.uint64]
    stamps_ns: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    component: NDArray[np.int64]
    edge_ids: NDArray[np.uint64]
    source_ids: NDArray[np.uint64]
    target_ids: NDArray[np.uint64]
    kind: NDArray[np.int64]
    score: NDArray[np.float64]
    is_outlier: NDArray[np.bool_]
    diagnostics: dict[str, str] = field(default_factory=dict)
    answers: int = 0
