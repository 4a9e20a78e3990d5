"""How well an answer explains closures that are not part of it, judged by their residuals.

A closure that is not part of an answer does not pull it, so its residual is that of a left-out measurement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.online.answer.gauge import extend_along_edges
from rotavg_ros.solver.solution import Solution, angles_off, distances_off
from rotavg_ros.view_graph import ViewGraph

# A closure's standard deviation per component, radians and metres: the default where too few closures are believed, and
# the least value used, since the residual of a closure that is part of an answer is smaller than its error.
_DEVIATION, _LEAST_DEVIATION = np.radians(2.0), np.radians(1.0)
_DEVIATION_M, _LEAST_DEVIATION_M = 0.5, 0.1
# Number of believed closures needed to estimate the standard deviation, and about how many of them are looked at.
_ENOUGH, _AT_MOST = 10, 1000
# The median of an absolute value of the standard normal distribution is 1 / 1.4826.
_DEVIATION_PER_MEDIAN = 1.4826
# Beyond it a score is 0 or 1 in double precision, and the exponential may overflow.
_CERTAIN = 40.0
_COLUMNS = ("body_from_world", "variance", "component", "position", "position_variance")


@dataclass(frozen=True)
class Known:
    """What an answer knows of its n keyframes, and the standard deviations of its closures.

    Attributes:
        body_from_world: ``(n, 4)``.
        variance: ``(n,)`` rad² of each component of the orientation, relative to the component's first keyframe;
            0 where the method gives none.
        component: ``(n,)`` connected component.
        step_variance: rad², variance of the orientation that each step of odometry adds, per component.
        deviation: rad, standard deviation of each component of a good closure's rotation.
        position: ``(n, 3)`` metres in the answer's world; None where there are none.
        position_variance: ``(n,)`` m² of each component; None likewise.
        deviation_m: metres, of each component of a good closure's translation.
    """

    body_from_world: Tensor
    variance: Tensor
    component: Tensor
    step_variance: float = 0.0
    deviation: float = float(_DEVIATION)
    position: Tensor | None = None
    position_variance: Tensor | None = None
    deviation_m: float = _DEVIATION_M

    @classmethod
    def of_solution(cls, graph: ViewGraph, solution: Solution, believed: NDArray[np.bool_]) -> Known:
        """What a solution of a graph knows.

        Args:
            graph: N keyframes, M edges, as it was solved.
            solution: of this graph.
            believed: ``(M,)`` closures that are not outliers.
        """
        some = np.flatnonzero(believed)
        closures = graph.select_edges(torch.from_numpy(some[:: max(1, len(some) // _AT_MOST)]))
        body_from_world, position = solution.body_from_world.cpu(), solution.position
        ends = closures.source, closures.target
        turned = np.radians(angles_off(body_from_world, closures.target_from_source, *ends))
        moved = np.empty(0)
        if position is not None and closures.translation is not None:
            moved = distances_off(body_from_world, position.cpu(), closures.translation, *ends)
        step, variance_m = solution.step_deviation, solution.position_uncertainty
        return cls(
            body_from_world,
            torch.nan_to_num(solution.uncertainty.cpu().double()).square(),
            solution.component.cpu(),
            step * step if np.isfinite(step) else 0.0,
            _deviation(turned, _DEVIATION, _LEAST_DEVIATION),
            None if position is None else position.cpu(),
            None if variance_m is None else torch.nan_to_num(variance_m.cpu()).square(),
            _deviation(moved, _DEVIATION_M, _LEAST_DEVIATION_M),
        )

    @classmethod
    def of_orientations(cls, body_from_world: Tensor, solved: ViewGraph) -> Known:
        """From orientations ``(n, 4)`` alone, all that a state file keeps of an answer.

        Args:
            body_from_world: of the first n nodes.
            solved: graph of the edges that it was an answer to.
        """
        nothing = torch.zeros(len(body_from_world), dtype=torch.float64)
        return cls(body_from_world, nothing, solved.components()[: len(body_from_world)])

    def of_keyframes(self, nodes: Callable[[Tensor], Tensor]) -> Known:
        """The same for the keyframes that a compaction has left; ``nodes`` selects their rows."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in _COLUMNS}
        left: dict[str, Any] = {name: nodes(column) for name, column in columns.items() if column is not None}
        return replace(self, **left)

    def carried_on(self, graph: ViewGraph) -> Known:
        """The same extended to all N ≥ n keyframes of a graph that has grown, along its edges, odometry first.

        A new keyframe has the variance of the last known one, plus one step's for each keyframe since; its position is
        NaN.
        """
        known, new = len(self.body_from_world), graph.num_nodes - len(self.body_from_world)
        if new <= 0:
            return self
        steps = torch.arange(1, new + 1)
        variance = (self.variance[-1] if known else 0.0) + self.step_variance * steps
        nowhere = torch.full((new, 3), torch.nan, dtype=torch.float64)
        return replace(
            self,
            body_from_world=extend_along_edges(self.body_from_world, graph),
            variance=torch.cat((self.variance, variance)),
            component=graph.components(),
            position=None if self.position is None else torch.cat((self.position, nowhere)),
            position_variance=(
                None if self.position_variance is None else torch.cat((self.position_variance, nowhere[:, 0]))
            ),
        )

    def log_odds(self, closures: ViewGraph, graph: ViewGraph) -> NDArray[np.float64]:
        """``(K,)`` nats, of each closure being good against being false, with even prior odds.

        The error of a good one is normal, with its own variance plus those of its ends, which count as independent. A
        false one has any rotation, and any place within the map. Between components nothing is known: 0.

        Args:
            closures: K of the graph's edges.
            graph: where all its rotations share an axis, any rotation means any about this axis.
        """
        components = graph.rotation_components
        source, target = closures.source, closures.target
        turned = np.radians(angles_off(self.body_from_world, closures.target_from_source, source, target))
        variance = self.deviation**2 + (self.variance[source] + self.variance[target]).numpy()
        if components == 1:
            anywhere = np.full(len(turned), np.log(2 * np.pi))
        else:
            # Density of a rotation vector of angle r where all rotations are equally likely: (2 sin(r/2) / r)² / 8π².
            anywhere = np.log(8 * np.pi**2) - 2 * np.log(np.sinc(turned / (2 * np.pi)))
        odds = anywhere - components / 2 * np.log(2 * np.pi * variance) - turned**2 / (2 * variance)
        odds += self._log_odds_of_places(closures, 2 if components == 1 else 3)
        return np.where((self.component[source] == self.component[target]).numpy(), odds, 0.0)

    def _log_odds_of_places(self, closures: ViewGraph, components: int) -> NDArray[np.float64]:
        """The same from translations alone; 0 where a position or a translation is not known."""
        if self.position is None or self.position_variance is None or closures.translation is None:
            return np.zeros(closures.num_edges)
        source, target = closures.source, closures.target
        moved = distances_off(self.body_from_world, self.position, closures.translation, source, target)
        size = max(_extent(self.position.numpy()), self.deviation_m)
        variance = self.deviation_m**2 + (self.position_variance[source] + self.position_variance[target]).numpy()
        anywhere = np.log(np.pi * size**2 if components == 2 else 4 / 3 * np.pi * size**3)
        odds = anywhere - components / 2 * np.log(2 * np.pi * variance) - moved**2 / (2 * variance)
        return np.asarray(np.nan_to_num(odds))


def _extent(position: NDArray[np.float64]) -> float:
    """Metres, the longest side of the box around positions ``(n, 3)``."""
    known = position[np.isfinite(position).all(axis=1)]
    return float((known.max(axis=0) - known.min(axis=0)).max()) if len(known) else 0.0


def score_of(log_odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Probability of being false ``(K,)``."""
    return np.asarray(1 / (1 + np.exp(np.clip(log_odds, -_CERTAIN, _CERTAIN))))


def _deviation(residual: NDArray[np.float64], otherwise: float, least: float) -> float:
    """Standard deviation of a component, from the absolute residuals of believed closures.

    In 3D it comes out up to 2.3 times too large, since an angle then has three components. Too large a value lets in
    closures that could wait.
    """
    residual = residual[np.isfinite(residual)]
    if len(residual) < _ENOUGH:
        return float(otherwise)
    return max(float(least), _DEVIATION_PER_MEDIAN * float(np.median(residual)))
