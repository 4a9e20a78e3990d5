"""The rows of the linear system at a state: residuals, variances, weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.posterior.densities import Sites, Tails, anyhow
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import Noise, Others, State
from rotavg_ros.solver.slam.posterior.system import Factorised

# Weight of a false closure relative to a good one: negligible, but the system stays solvable.
_NOTHING = 1e-10
# Floor of 1 − w R; it vanishes for an edge that alone connects two parts.
_LEAST_REST = 1e-6
# Largest number of consecutive steps with far larger errors: a bump, a stretch of uneven floor. Without this bound a
# slip of half a turn in a long segment would pass for drift.
_LONGEST_STRETCH = 30.0
# Largest turn of a node in one step, rad; the linear system is not valid beyond it.
_MAX_TURN = 1.0


def variances(problem: Problem, noise: Noise) -> np.ndarray:
    """``(E + R,)`` rad² of every row's own noise if it is good; for closures, without the part shared by their run."""
    graph, system = problem.graph, problem.system(noise)
    steps = graph.own_steps + noise.turn_share * (problem.turn_steps - graph.own_steps)
    variance = steps * noise.step_variance
    variance[problem.beside] *= noise.beside
    closure = problem.closure
    own = np.where(system.shared[closure], 1 - noise.common_share, 1.0)
    variance[closure] = own * np.exp(noise.exponent * problem.stated_ratio) * noise.closure_variance
    if problem.relative is not None:
        variance *= problem.relative
    common = np.full(system.num_runs, noise.common_share * noise.closure_variance)
    return np.concatenate((variance, common))


def tails(problem: Problem, noise: Noise) -> Tails:
    """Tails of each of E edges if it is good, by its kind; in a long segment only some steps err by more."""
    is_odometry = problem.graph.is_odometry
    share = np.minimum(1.0, _LONGEST_STRETCH / np.maximum(problem.graph.own_steps, 1.0))
    return Tails(
        np.where(is_odometry, noise.step_tails, noise.closure_tails),
        np.where(is_odometry, 1 + (noise.step_tail_ratio - 1) * share, problem.priors.tail_ratio),
        np.where(is_odometry, noise.step_told, 1.0),
    )


def residuals(problem: Problem, state: State) -> np.ndarray:
    """``(E + R, 3)`` rad, residuals of all rows."""
    graph, system = problem.graph, problem.system(state.noise)
    vectors = quaternion_rows.residual_vectors(state.correction, problem.measured, graph.source, graph.target)
    edges = np.flatnonzero(system.shared)
    vectors[edges] -= system.sign[edges, None] * state.common[system.run[edges]]
    return np.concatenate((vectors, -state.common))


def with_noise(problem: Problem, state: State, noise: Noise) -> State:
    """The state under another θ; if the runs change, their common errors begin at zero."""
    if noise.run_steps == state.noise.run_steps:
        return replace(state, noise=noise)
    return replace(state, noise=noise, common=np.zeros((problem.system(noise).num_runs, 3)))


def moved(state: State, step: np.ndarray) -> State:
    """The state after a Gauss–Newton step ``(K + R, 3)``, shortened where it is long."""
    step = step / max(1.0, float(np.abs(step).max(initial=0.0)) / _MAX_TURN)
    num_nodes = state.correction.shape[1]
    turned = quaternion_rows.multiply(state.correction, quaternion_rows.exp(step[:num_nodes].T))
    return replace(state, correction=quaternion_rows.normalize(turned), common=state.common + step[num_nodes:])


def sites(problem: Problem, state: State, residual: np.ndarray, variance: np.ndarray) -> Sites:
    """Sites of all edges, with the predictions by all others from the last solve.

    Args:
        problem: the graph.
        state: the state after that solve.
        residual: ``(E + R, 3)`` rad.
        variance: ``(E + R,)`` rad² of :func:`variances`.
    """
    others = state.others
    num_edges = len(others.rest)
    square = np.minimum((residual[:num_edges] ** 2).sum(axis=1) / others.rest**2, np.pi**2)
    own, tailed = variance[:num_edges], tails(problem, state.noise)
    return Sites.of(square, own, others.predicted, problem.components, tailed)


def weights_if_good(state: State, own: np.ndarray, site: Sites) -> np.ndarray:
    """``(E,)`` rad⁻²: halfway, in the logarithm, from the last weights (initially those of normal noise) to the sites'.

    Otherwise edges that depend on each other could alternate between two answers forever.
    """
    return np.asarray(np.sqrt(state.others.relative / own * site.weight))


def with_others(
    state: State,
    factorised: Factorised,
    if_good: np.ndarray,
    own: np.ndarray,
    components: int,
    *,
    all_rows: bool = True,
) -> State:
    """The state after a solve, with the prediction of each edge by all others.

    The prediction is combined with the fact that a residual is a rotation. So an edge that alone connects two parts has
    no informative prediction, and nothing contradicts it.

    Args:
        state: the state before.
        factorised: H of the solve.
        if_good: ``(E,)`` rad⁻², weights of the edges in it as good ones.
        own: ``(E,)`` rad², their variances.
        components: k.
        all_rows: also update rows of no weight; otherwise these keep their predictions.
    """
    resistance = (factorised.resistance if all_rows else factorised.resistance_of_kept)[: len(own)]
    rest = np.maximum(1 - factorised.weight[: len(own)] * resistance, _LEAST_REST)
    predicted = resistance / rest
    limited = 1 + predicted / anyhow(components)
    rest, predicted = rest * limited, predicted / limited
    if not all_rows:
        stays = np.isnan(resistance)
        rest = np.where(stays, state.others.rest, rest)
        predicted = np.where(stays, state.others.predicted, predicted)
    return replace(state, others=Others(rest, predicted, if_good * own))


def weights(problem: Problem, state: State, good: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """``(E + R,)`` rad⁻² of all rows.

    Where a label is a probability P, the weight makes the residual equal to its mean over both labels: if all others
    predict it with variance p, a weight w leaves the share 1 / (1 + w p) of the discrepancy. So an edge that is good
    with probability ¼ moves what it alone determines by a quarter of what it would as a good edge. The weight P w would
    move it nearly as far as a good edge does.

    Args:
        problem: the graph.
        state: labels.
        good: ``(E,)`` rad⁻², weights of the edges as good ones.
        variance: ``(E + R,)`` rad² of :func:`variances`.
    """
    num_edges = len(problem.graph.source)
    slipped = 1 / (variance[:num_edges] + np.radians(problem.priors.slip_deg) ** 2)
    otherwise = np.where(problem.graph.is_odometry, slipped, _NOTHING * good)
    if_good = state.trusted / (1 + good * state.others.predicted)
    if_not = (1 - state.trusted) / (1 + otherwise * state.others.predicted)
    weight = (if_good * good + if_not * otherwise) / (if_good + if_not)
    return np.concatenate((_bridged(problem, state, weight), 1 / variance[num_edges:]))


def _bridged(problem: Problem, state: State, weight: np.ndarray) -> np.ndarray:
    """Weights ``(E,)`` in which each part that only false closures connect is held by one edge.

    A part that nothing holds may be turned by any rotation; a normal density of the same volume replaces the uniform.
    """
    if problem.is_held:
        return weight
    graph = problem.graph
    holds = graph.is_odometry | state.is_good
    ends = graph.source[holds], graph.target[holds]
    held = coo_array((np.ones(len(ends[0])), ends), shape=(graph.num_nodes,) * 2)
    parts, part = connected_components(held.tocsr(), directed=False)
    if parts == len(graph.roots):
        return weight
    loose = np.flatnonzero(~holds)
    low, high = np.sort(np.stack((part[graph.source[loose]], part[graph.target[loose]])), axis=0)
    between, first = np.unique(low * parts + high, return_index=True)
    # It makes no difference which of several edges between two parts is used.
    bridges = coo_array((1.0 + np.arange(len(between)), np.divmod(between, parts)), shape=(parts, parts))
    chosen = minimum_spanning_tree(bridges.tocsr()).data.astype(np.int64) - 1
    weight = weight.copy()
    weight[loose[first[chosen]]] = 1 / anyhow(problem.components)
    return weight
