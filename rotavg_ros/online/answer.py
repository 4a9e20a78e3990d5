"""What one tick of the estimator says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Answer:
    """Absolute orientations of all keyframes and a verdict on every edge (N keyframes, M edges).

    Attributes:
        version: counts the answers of an estimator, from 1.
        robots: names.
        keyframe_robot: ``(N,)`` int32 index into ``robots``.
        keyframe_id: ``(N,)`` uint64.
        stamp_ns: ``(N,)`` int64, -1 where unknown.
        world_from_body: ``(N, 4)`` float64 xyzw, w ≥ 0, in the component's fixed gauge.
        component: ``(N,)`` int64, numbered by first keyframe.
        uncertainty: ``(N,)`` float64, one sigma in radians relative to the component's first keyframe, NaN unknown.
        edge_id: ``(M,)`` uint64, the sender's; 2⁶⁴-1 for the estimator's own odometry edges.
        source, target: ``(M,)`` int64 indices into the keyframes.
        kind: ``(M,)`` int64 :class:`~rotavg_ros.view_graph.EdgeKind`.
        outlier_score: ``(M,)`` float64 in [0, 1].
        outlier: ``(M,)`` bool, score above the threshold; a user's label decides where there is one.
        was_cold: solved from scratch, as ``rotavg solve`` would.
        seconds: of the whole tick.
        stage_seconds: of the solver's stages.
        method, profile, device: as the solver resolved them.
    """

    version: int
    robots: tuple[str, ...]
    keyframe_robot: NDArray[np.int32]
    keyframe_id: NDArray[np.uint64]
    stamp_ns: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    component: NDArray[np.int64]
    uncertainty: NDArray[np.float64]
    edge_id: NDArray[np.uint64]
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    kind: NDArray[np.int64]
    outlier_score: NDArray[np.float64]
    outlier: NDArray[np.bool_]
    was_cold: bool
    seconds: float
    stage_seconds: dict[str, float]
    method: str
    profile: str
    device: str

    @property
    def num_components(self) -> int:
        return int(self.component.max()) + 1 if len(self.component) else 0

    def without_content(self) -> Answer:
        """The same answer about no keyframes and no edges."""
        arrays: dict[str, Any] = {
            name: value[:0] for name, value in vars(self).items() if isinstance(value, np.ndarray)
        }
        return replace(self, robots=(), **arrays)
