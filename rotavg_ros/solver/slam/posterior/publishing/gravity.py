"""A labelling's orientations where gravity holds roll and pitch, so that odometry errs about the vertical.

Turns about the vertical n and about other axes form two systems with the same rows. Labels and weights stay fixed,
except that odometry's variances are multiplied by one factor about n and another about other axes. Both factors are
estimated from residuals and their redundancy (restricted maximum likelihood). The search itself uses a single variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.noise.vertical import LEAST_TILT, TILT_SPREAD
from rotavg_ros.solver.slam.posterior.em import likeliest_variance
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import moved, residuals
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.posterior.system import Factorised

# Number of components of a turn about the vertical, and about other axes.
_COMPONENTS = np.array([1, 2])
# Maximum number of solves; largest change of the variances' logarithms at convergence.
_SOLVES, _CONVERGED = 8, 0.1


@dataclass(frozen=True)
class Held:
    """Orientations and their variances, rad² per component, averaged over components.

    Attributes:
        state: corrections of K key nodes.
        variance: ``(K,)`` variances of these.
        apart: ``(S,)`` variances of the difference between the two ends of each segment.
        factor: ``(2,)`` factors of odometry's variances, about the vertical and about other axes.
        with_first: ``(K,)`` covariances with their component's first node; None: that is the root.
    """

    state: State
    variance: np.ndarray
    apart: np.ndarray
    factor: np.ndarray
    with_first: np.ndarray | None

    @property
    def step_variance(self) -> float:
        """rad² per component, of one step of odometry."""
        return self.state.noise.step_variance * float(self.factor @ _COMPONENTS) / 3


def held_by_gravity(problem: Problem, state: State, solved: Factorised) -> Held:
    """The orientations of a labelling if axes may differ in variance; unchanged where no vertical is known.

    Args:
        problem: the graph.
        state: the converged state.
        solved: its last solve.
    """
    segments, nodes = problem.graph.num_segments, slice(problem.graph.num_nodes)
    vertical = None if "tilt" in problem.without else problem.upright
    sound = np.flatnonzero(state.is_good[:segments])
    if vertical is None or len(sound) == 0:
        told = solved.variance[nodes], solved.resistance[:segments], np.ones(2)
        return Held(state, *told, _with_first(problem, state, [solved], np.ones(1)))
    axis = vertical.sharpened(residuals(problem, state)[sound], 1 / solved.weight[sound])
    about = np.outer(axis, axis)
    both = _Both(problem, solved, sound, (about, np.eye(3) - about))
    factor = np.ones(2)
    for _ in range(_SOLVES):
        rest()
        used, solves = factor, both.factorised(factor)
        residual = residuals(problem, state)
        turn = np.sum([each.fit(residual @ axes) for each, axes in zip(solves, both.axes, strict=True)], axis=0)
        state = moved(state, turn)
        factor = both.likeliest(state, solves, used)
        if np.abs(np.log(factor / used)).max() < _CONVERGED:
            break
    of_nodes = np.tensordot(_COMPONENTS, [each.variance[nodes] for each in solves], 1) / 3
    apart = np.tensordot(_COMPONENTS, [each.resistance[:segments] for each in solves], 1) / 3
    return Held(state, of_nodes, apart, used, _with_first(problem, state, solves, _COMPONENTS / 3))


def _with_first(problem: Problem, state: State, solves: list[Factorised], share: np.ndarray) -> np.ndarray | None:
    """``(K,)`` rad² of key nodes and their component's first node, averaged; None where that is the root."""
    graph = problem.drawn(state.noise)
    if graph.is_held_at_first:
        return None
    column = np.zeros((solves[0].system.size, 1))
    column[: graph.num_nodes] = graph.first_column
    told = [each.solve(column)[: graph.num_nodes, 0] for each in solves]
    return np.asarray(np.tensordot(share, told, 1))


@dataclass(frozen=True)
class _Both:
    """The systems of turns about the vertical and about other axes.

    Attributes:
        problem: the graph.
        solved: the solve with a single variance.
        sound: ``(n,)`` segments that have not slipped.
        axes: ``(3, 3)`` each, projections of turns.
    """

    problem: Problem
    solved: Factorised
    sound: np.ndarray
    axes: tuple[np.ndarray, np.ndarray]

    def factorised(self, factor: np.ndarray) -> list[Factorised]:
        """Both systems, with odometry's variances multiplied by ``(2,)``."""
        weights = np.stack([self.solved.weight] * 2)
        weights[:, self.sound] /= factor[:, None]
        return [self.solved.system.factorise(weight) for weight in weights]

    def likeliest(self, state: State, solves: list[Factorised], used: np.ndarray) -> np.ndarray:
        """``(2,)`` likeliest factors of odometry's variances, after solves with the factors ``used``."""
        priors, step = self.problem.priors, state.noise.step_variance
        usual = 2 * float(np.log(np.radians(priors.step_deg))), priors.noise_spread
        left, told = residuals(self.problem, state)[self.sound], []
        for solve, axes, count, before in zip(solves, self.axes, _COMPONENTS, step * used, strict=True):
            weight = solve.weight[self.sound]
            squares = (weight * ((left @ axes) ** 2).sum(axis=1)).sum()
            told.append((before * squares, count * (1 - weight * solve.resistance_of_kept[self.sound]).sum()))

        def likeliest(squares: float, freedom: float, number: int, prior: tuple[float, float]) -> float:
            return likeliest_variance(squares, max(freedom, 0.0), float(np.log(step * used[number])), *prior)

        about = likeliest(*told[0], 0, usual)
        # The factor for other axes has a prior relative to that for the vertical, and is not larger.
        other = likeliest(*told[1], 1, (float(np.log(about)), TILT_SPREAD))
        if other > about:
            squares, freedom = np.sum(told, axis=0).tolist()
            about = other = likeliest(squares, freedom, 0, usual)
        return np.array([about, max(other, LEAST_TILT**2 * about)]) / step
