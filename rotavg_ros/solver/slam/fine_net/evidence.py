"""A solve's evidence on the error of each edge: the arrays from which FineNet's features are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import residuals, sites, variances, weights_if_good
from rotavg_ros.solver.slam.posterior.state import Noise, State


@dataclass(frozen=True)
class Evidence:
    """Evidence on the E edges of a closure graph with K key nodes, C of them closures, after a solve.

    Attributes:
        source, target: ``(E,)`` key nodes.
        is_odometry: ``(E,)`` bool.
        is_good: ``(E,)`` bool, labels.
        own: ``(E,)`` rad², v, the variance of each edge's own noise as estimated.
        residual_square: ``(E,)`` rad², ‖r‖².
        weight: ``(E,)`` rad⁻², weight of each edge as a good one; with tails it differs from 1 / v.
        rest: ``(E,)`` 1 − w R, residual over the discrepancy with the prediction by all others.
        square: ``(E,)`` rad², ‖μ‖², squared discrepancy with the prediction by all others.
        predicted: ``(E,)`` rad², p, variance of that prediction.
        log_density: ``(E,)`` nats, of μ if the edge is good, tails included.
        log_relative: ``(E,)`` log ratio of v to that of the noise model, from an earlier pass, else 0.
        position: ``(E, 2)`` where the older and the newer end lie along the odometry, in steps; chains are far apart.
        run: ``(C,)`` number of each closure's run.
        steps: ``(E,)`` steps of odometry: of segments their own, of closures those between their ends.
        turn: ``(E,)`` squared turns of a segment's steps over the usual value; 1 where unknown, and for closures.
        length: ``(E,)`` metres a step over the usual value; 1 where unknown, and for closures.
        stated: ``(E,)`` logarithm of closures' stated variance over the usual value; 0 where unknown.
        noise: θ.
        components: k, 1 where all rotations share an axis, else 3.
    """

    source: np.ndarray
    target: np.ndarray
    is_odometry: np.ndarray
    is_good: np.ndarray
    own: np.ndarray
    residual_square: np.ndarray
    weight: np.ndarray
    rest: np.ndarray
    square: np.ndarray
    predicted: np.ndarray
    log_density: np.ndarray
    log_relative: np.ndarray
    position: np.ndarray
    run: np.ndarray
    steps: np.ndarray
    turn: np.ndarray
    length: np.ndarray
    stated: np.ndarray
    noise: Noise
    components: int

    @classmethod
    def of(cls, problem: Problem, state: State) -> Evidence:
        """After a solve, whose ``state`` holds the prediction of each edge by all others."""
        graph, num_edges = problem.graph, len(problem.graph.source)
        residual, variance = residuals(problem, state), variances(problem, state.noise)
        own, site = variance[:num_edges], sites(problem, state, residual, variance)
        none, closure = np.zeros(num_edges), problem.closure
        stated = none.copy()
        stated[closure] = problem.stated_ratio
        relative = np.ones(num_edges) if problem.relative is None else problem.relative
        return cls(
            source=graph.source,
            target=graph.target,
            is_odometry=graph.is_odometry,
            is_good=state.is_good,
            own=own,
            residual_square=(residual[:num_edges] ** 2).sum(axis=1),
            weight=weights_if_good(state, own, site),
            rest=state.others.rest,
            square=site.square,
            predicted=site.predicted,
            log_density=site.log_density,
            log_relative=np.log(relative),
            position=np.sort(graph.position[np.stack((graph.source, graph.target), axis=1)], axis=1),
            run=problem.run if len(closure) else np.zeros(0, dtype=np.int64),
            steps=np.where(graph.is_odometry, graph.own_steps, graph.path_steps),
            turn=_of_segments(problem.turn_steps, problem),
            length=_of_segments(problem.length_steps, problem),
            stated=stated,
            noise=state.noise,
            components=problem.components,
        )


def _of_segments(shared_out: np.ndarray, problem: Problem) -> np.ndarray:
    """``(E,)`` redistributed steps of segments over their actual number; 1 for all other edges."""
    graph = problem.graph
    is_known = graph.is_odometry & (graph.own_steps > 0)
    return np.asarray(np.divide(shared_out, graph.own_steps, out=np.ones(len(shared_out)), where=is_known))
