"""What one tick of the estimator says."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.online.answer.gauge import component_roots
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.solver.solution import angles_off, distances_off
from rotavg_ros.view_graph import EdgeLabel
from rotavg_ros.wording import with_names

if TYPE_CHECKING:
    from rotavg_ros.solver import Solution


@dataclass(frozen=True)
class Answer:
    """Absolute orientations of all keyframes and a verdict on every edge (N keyframes, M edges).

    Attributes:
        version: counts the answers of an estimator, from 1.
        robots: names.
        keyframe_robot: ``(N,)`` int32 index into ``robots``.
        keyframe_id: ``(N,)`` uint64.
        stamp_ns: ``(N,)`` int64, -1 where unknown.
        time_line: ``(N,)`` int64, which of its robot's time lines the stamp belongs to. When a robot's clock goes
            back, a new time line begins, and the same stamps may come again.
        world_from_body: ``(N, 4)`` float64 xyzw, w ≥ 0, in the component's fixed gauge.
        component: ``(N,)`` int64, numbered by first keyframe.
        uncertainty: ``(N,)`` float64, one sigma in radians relative to the component's first keyframe, NaN unknown.
        edge_id: ``(M,)`` uint64, the sender's; 2⁶⁴-1 for the estimator's own odometry edges.
        source, target: ``(M,)`` int64 indices into the keyframes.
        kind: ``(M,)`` int64 :class:`~rotavg_ros.view_graph.EdgeKind`.
        target_from_source: ``(M, 4)`` xyzw, as measured.
        precision: ``(M,)`` rad⁻², NaN unknown.
        translation: ``(M, 3)`` position of the target in the source's frame, metres; NaN unknown.
        steps: ``(M,)`` number of odometry steps that an odometry edge stands for; more than one where keyframes in
            between were marginalised.
        outlier_score: ``(M,)`` float64 in [0, 1].
        outlier: ``(M,)`` bool, score above the edge's threshold; a user's label decides where there is one.
        waits: ``(M,)`` bool, closures that are not part of the solve yet; their scores come from their residuals.
        was_cold: solved from scratch, as ``rotavg solve`` would.
        seconds: duration of the whole tick.
        work: units of work that the solver has spent, see :attr:`rotavg_ros.solver.solution.Solution.work`.
        stage_seconds: duration of each of the solver's stages.
        method, profile, device: as the solver resolved them.
        warnings: reasons not to trust the answer, a sentence each.
        position: ``(N, 3)`` metres in the component's gauge, its first keyframe at the origin; None where translations
            were unknown or not used.
        position_uncertainty: ``(N,)`` metres, one sigma of each component; None likewise.
        rotation_score: ``(M,)`` in [0, 1], score for the edge's rotation alone being wrong; None likewise.
        edge_precision: ``(M, 2)`` rad⁻² and m⁻² per component, the weights of the edges; None likewise.
        step_deviation: standard deviation of each component of an odometry step, radians; NaN unknown.
    """

    version: int
    robots: tuple[str, ...]
    keyframe_robot: NDArray[np.int32]
    keyframe_id: NDArray[np.uint64]
    stamp_ns: NDArray[np.int64]
    time_line: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    component: NDArray[np.int64]
    uncertainty: NDArray[np.float64]
    edge_id: NDArray[np.uint64]
    source: NDArray[np.int64]
    target: NDArray[np.int64]
    kind: NDArray[np.int64]
    target_from_source: NDArray[np.float64]
    precision: NDArray[np.float64]
    translation: NDArray[np.float64]
    steps: NDArray[np.float64]
    outlier_score: NDArray[np.float64]
    outlier: NDArray[np.bool_]
    waits: NDArray[np.bool_]
    was_cold: bool
    seconds: float
    stage_seconds: dict[str, float]
    method: str
    profile: str
    device: str
    warnings: tuple[str, ...] = ()
    position: NDArray[np.float64] | None = None
    position_uncertainty: NDArray[np.float64] | None = None
    rotation_score: NDArray[np.float64] | None = None
    edge_precision: NDArray[np.float64] | None = None
    step_deviation: float = math.nan
    work: float = 0.0

    @classmethod
    def of_solution(
        cls,
        snapshot: GraphSnapshot,
        solution: Solution,
        body_from_world: Tensor,
        outlier_threshold: NDArray[np.float64],
        version: int,
        was_cold: bool,
    ) -> Answer:
        """The answer from a snapshot's solution, with orientations ``(N, 4)`` in their fixed gauge; ``seconds`` is 0.

        An edge is an outlier if its score exceeds its threshold, ``(M,)``. Edges that a user has accepted get the
        score 0, rejected ones 1; the latter are outliers whatever the threshold.
        """
        graph = snapshot.graph
        score = solution.outlier_score.cpu()
        is_rejected = graph.label == EdgeLabel.REJECTED
        score = torch.where(graph.label == EdgeLabel.ACCEPTED, 0.0, score)
        score = torch.where(is_rejected, 1.0, score)
        return cls(
            version=version,
            robots=snapshot.robots,
            keyframe_robot=snapshot.keyframe_robot,
            keyframe_id=snapshot.keyframe_id,
            stamp_ns=snapshot.stamp_ns,
            time_line=snapshot.time_line,
            world_from_body=rotations.canonical(rotations.inverse(body_from_world)).numpy(),
            component=solution.component.cpu().numpy(),
            uncertainty=solution.uncertainty.cpu().numpy(),
            edge_id=snapshot.edge_id,
            source=graph.source.numpy(),
            target=graph.target.numpy(),
            kind=graph.kind.numpy(),
            target_from_source=graph.target_from_source.numpy(),
            precision=graph.precision.numpy(),
            translation=snapshot.translation,
            steps=graph.steps.numpy(),
            outlier_score=score.numpy(),
            outlier=(score.numpy() > outlier_threshold) | is_rejected.numpy(),
            waits=np.zeros(graph.num_edges, dtype=bool),
            was_cold=was_cold,
            seconds=0.0,  # known when the tick is over
            stage_seconds=dict(solution.stage_seconds),
            method=solution.method,
            profile=solution.profile,
            device=solution.device,
            warnings=with_names(solution.warnings, snapshot.keyframe_name),
            position=_in_gauge(solution, body_from_world),
            position_uncertainty=_numbers(solution.position_uncertainty),
            rotation_score=_numbers(solution.rotation_score),
            edge_precision=_numbers(solution.edge_precision),
            step_deviation=solution.step_deviation,
            work=solution.work,
        )

    @cached_property
    def residual_deg(self) -> NDArray[np.float64]:
        """``(M,)`` angle between each edge's measured rotation and the answer's, degrees."""
        return angles_off(self._body_from_world, torch.from_numpy(self.target_from_source), *self._ends)

    @cached_property
    def residual_m(self) -> NDArray[np.float64] | None:
        """``(M,)`` the same for translations, metres; NaN where an edge has none. None without positions."""
        if self.position is None:
            return None
        position, translation = torch.from_numpy(self.position), torch.from_numpy(self.translation)
        return distances_off(self._body_from_world, position, translation, *self._ends)

    @property
    def _body_from_world(self) -> Tensor:
        return rotations.inverse(torch.from_numpy(self.world_from_body))

    @property
    def _ends(self) -> tuple[Tensor, Tensor]:
        return torch.from_numpy(self.source), torch.from_numpy(self.target)

    @property
    def num_components(self) -> int:
        return int(self.component.max()) + 1 if len(self.component) else 0

    @property
    def newest_stamp_ns(self) -> int:
        """Newest stamp of all keyframes on their robots' latest time lines; 0 without any stamp."""
        latest = np.zeros(len(self.robots), dtype=np.int64)
        np.maximum.at(latest, self.keyframe_robot, self.time_line)
        is_latest = self.time_line == latest[self.keyframe_robot]
        return int(self.stamp_ns[is_latest].max(initial=0))

    def without_content(self) -> Answer:
        """The same answer without keyframes and edges."""
        arrays: dict[str, Any] = {
            each.name: value[:0] for each in fields(self) if isinstance(value := getattr(self, each.name), np.ndarray)
        }
        return replace(self, robots=(), warnings=(), **arrays)


def _in_gauge(solution: Solution, body_from_world: Tensor) -> NDArray[np.float64] | None:
    """Positions ``(N, 3)`` in the gauge; the solution has them in the frame of each component's first keyframe."""
    if solution.position is None:
        return None
    component = solution.component.cpu()
    turn = rotations.inverse(body_from_world[component_roots(component)])[component]
    return np.asarray(rotations.rotate(turn, solution.position.cpu()).numpy())


def _numbers(values: Tensor | None) -> NDArray[np.float64] | None:
    return None if values is None else np.asarray(values.cpu().numpy())
