"""Let odometry slip where one turn explains closures that are held false, or take a slip back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.left_out import CERTAIN, relabelled, rough_cost
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.state import State

_SETTLING = 4
# What relabelling and bending may gain beyond what residuals tell of a part that is turned back, nats.
_OPTIMISM = 10.0
# A turn explains a closure that is off by it to so many standard deviations, or to this angle, rad.
_AGREE, _AGREE_ANGLE = 3.0, np.radians(2.0)


def propose_slips(mode: Mode) -> Iterator[Proposal]:
    """Segments where a turn would explain most of the closures that are held false."""
    problem, state = mode.problem, mode.state
    graph, closure, is_false = problem.graph, problem.closure, mode.is_false
    rejected = np.flatnonzero(is_false)
    if len(rejected) < 2:
        return
    turned = quaternion_rows.residual(state.correction, problem.measured, graph.source, graph.target)[:, closure]
    turned = np.where(problem.sign > 0, turned, quaternion_rows.inverse(turned))
    chain = graph.paths.chain[graph.nodes]
    within = chain[graph.source[closure]] == chain[graph.target[closure]]
    segment = np.flatnonzero(state.is_good[: graph.num_segments])
    if len(segment) == 0:
        return
    start = np.minimum(graph.position[graph.source[segment]], graph.position[graph.target[segment]])
    order = np.argsort(start, kind="stable")
    segment, start = segment[order], start[order]
    first = np.searchsorted(start, problem.ends[:, 0] - 1e-9)
    last = np.searchsorted(start, problem.ends[:, 1] - 1e-9)
    tolerance = 2 * _AGREE**2 * problem.components * state.noise.closure_variance + _AGREE_ANGLE**2
    # What closures gain if they come out good, and lose if they come out wrong.
    worth = np.clip(mode.left_out.worth[closure], 0.0, CERTAIN)
    lost = np.where(within & ~is_false, -worth, 0.0)
    price = -mode.left_out.log_odds[segment]
    left = within & is_false
    found = []
    for seed in rejected:
        if not left[seed]:
            continue
        difference = 2 * np.arccos(np.minimum(np.abs(turned[:, seed] @ turned), 1.0))
        agrees = (difference**2 < tolerance) & within & is_false
        left[agrees] = False
        gain = np.where(agrees, worth, lost)
        across = np.zeros(len(segment) + 1)
        np.add.at(across, first, gain)
        np.add.at(across, last, -gain)
        predicted = -(np.cumsum(across)[:-1] + price)
        best = int(np.argmin(predicted))
        found.append((float(predicted[best]), int(segment[best]), turned[:, [seed]]))
    for predicted, edge, turn in sorted(found, key=lambda slip: slip[0])[: problem.limits.slips]:
        yield Proposal("slip", predicted, partial(_with_slip, mode, edge, turn))


def propose_mending(mode: Mode) -> Iterator[Proposal]:
    """Take back each slip: with all that follows, up to the next slip, or bending what is between."""
    slipped = mode.slipped
    before = rough_cost(mode.problem, mode.state)
    for number, edge in enumerate(slipped[: mode.problem.limits.slips]):
        following = int(slipped[number + 1]) if number + 1 < len(slipped) else None
        for name, end in (("mend and reject", None), ("turn a part back", following)):
            if end is not None or name == "mend and reject":
                state = _mended(mode, int(edge), end)
                predicted = rough_cost(mode.problem, state) - before - _OPTIMISM
                yield Proposal(name, predicted, partial(settle, mode.problem, state, _SETTLING))
        bends = -float(mode.left_out.log_odds[edge])
        yield Proposal("mend and bend", bends - _OPTIMISM, partial(_bent, mode, int(edge)))


def _after(mode: Mode, edge: int) -> np.ndarray:
    """``(K,)`` bool, all that follows a segment along its chain."""
    graph = mode.problem.graph
    chain = graph.paths.chain[graph.nodes]
    end = max(graph.position[graph.source[edge]], graph.position[graph.target[edge]])
    return np.asarray((chain == chain[graph.source[edge]]) & (graph.position >= end))


def _turned(mode: Mode, nodes: np.ndarray, turn: np.ndarray) -> State:
    """Nodes turned by ``turn`` ``(4, 1)``."""
    correction = mode.state.correction.copy()
    correction[:, nodes] = quaternion_rows.multiply(correction[:, nodes], turn)
    return replace(mode.state, correction=correction)


def _with_slip(mode: Mode, edge: int, turn: np.ndarray) -> State:
    state = _turned(mode, _after(mode, edge), turn)
    trusted = relabelled(mode.problem, state)
    odometry = mode.problem.graph.is_odometry
    trusted[odometry] = mode.state.trusted[odometry]
    trusted[edge] = 0.0
    return settle(mode.problem, replace(state, trusted=trusted), _SETTLING)


def _mended(mode: Mode, edge: int, following: int | None) -> State:
    graph = mode.problem.graph
    pair = np.array([edge])
    turn = quaternion_rows.residual(
        mode.state.correction, mode.problem.measured[:, pair], graph.source[pair], graph.target[pair]
    )
    nodes = _after(mode, edge)
    if graph.position[graph.source[edge]] > graph.position[graph.target[edge]]:
        turn = quaternion_rows.inverse(turn)
    if following is not None:
        nodes &= ~_after(mode, following)
    state = _turned(mode, nodes, turn)
    trusted = relabelled(mode.problem, state)
    odometry = graph.is_odometry
    kept = mode.state.trusted[odometry]
    trusted[odometry] = np.maximum(kept, trusted[odometry])
    trusted[edge] = 1.0
    return replace(state, trusted=trusted)


def _bent(mode: Mode, edge: int) -> State:
    trusted = mode.state.trusted.copy()
    trusted[edge] = 1.0
    return settle(mode.problem, replace(mode.state, trusted=trusted), _SETTLING)
