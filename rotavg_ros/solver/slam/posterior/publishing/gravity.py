"""A labelling's orientations where gravity holds roll and pitch, so that odometry errs about the vertical.

A turn about the vertical n and one about other axes are two systems of the same rows. Labels and weights stay as they
are, but that odometry's variances are multiplied by one factor about n and by another one about other axes: the
redundancy that residuals leave tells both (restricted maximum likelihood). The search knows of one variance alone.
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

# Of a turn about the vertical, and about other axes.
_COMPONENTS = np.array([1, 2])
# Solves at most; variances are at rest when their logarithms change by no more.
_SOLVES, _CONVERGED = 8, 0.1


@dataclass(frozen=True)
class Held:
    """Orientations, and how far they err, rad² per component in the mean.

    Attributes:
        state: corrections of K key nodes.
        variance: ``(K,)`` of these.
        apart: ``(S,)`` of the difference between those at both ends of a segment.
        factor: ``(2,)`` of odometry's variances, about the vertical and about other axes.
    """

    state: State
    variance: np.ndarray
    apart: np.ndarray
    factor: np.ndarray

    @property
    def step_variance(self) -> float:
        """Of one step of odometry."""
        return self.state.noise.step_variance * float(self.factor @ _COMPONENTS) / 3


def held_by_gravity(problem: Problem, state: State, solved: Factorised) -> Held:
    """What a labelling comes to if all axes need not be alike; as it is where no vertical is known.

    Args:
        problem: the graph.
        state: at rest.
        solved: its last solve.
    """
    segments, nodes = problem.graph.num_segments, slice(problem.graph.num_nodes)
    vertical = None if "tilt" in problem.without else problem.upright
    sound = np.flatnonzero(state.is_good[:segments])
    if vertical is None or len(sound) == 0:
        return Held(state, solved.variance[nodes], solved.resistance[:segments], np.ones(2))
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
    return Held(state, of_nodes, apart, used)


@dataclass(frozen=True)
class _Both:
    """The systems of turns about the vertical and about other axes.

    Attributes:
        problem: the graph.
        solved: by one variance.
        sound: ``(n,)`` segments that have not slipped.
        axes: ``(3, 3)`` each, onto which turns are projected.
    """

    problem: Problem
    solved: Factorised
    sound: np.ndarray
    axes: tuple[np.ndarray, np.ndarray]

    def factorised(self, factor: np.ndarray) -> list[Factorised]:
        """Both, where odometry's variances are ``(2,)`` times as large."""
        weights = np.stack([self.solved.weight] * 2)
        weights[:, self.sound] /= factor[:, None]
        return [self.solved.system.factorise(weight) for weight in weights]

    def likeliest(self, state: State, solves: list[Factorised], used: np.ndarray) -> np.ndarray:
        """``(2,)`` how many times as large odometry's variances are, after solves by others ``used``."""
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
        # What is about other axes goes with what is about the vertical, and is no more: gravity holds or does not.
        other = likeliest(*told[1], 1, (float(np.log(about)), TILT_SPREAD))
        if other > about:
            squares, freedom = np.sum(told, axis=0).tolist()
            about = other = likeliest(squares, freedom, 0, usual)
        return np.array([about, max(other, LEAST_TILT**2 * about)]) / step
