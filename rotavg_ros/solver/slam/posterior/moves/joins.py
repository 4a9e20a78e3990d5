"""Moves that turn a chain of odometry as a whole: closures alone join it to others, and some of these say otherwise.

Those that are good hold the chain, so any other one is judged false because of them, whether or not false ones hold it.
No single label and no slip turns a whole chain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.graph.chain_cuts import ChainCuts, connected, with_most_runs
from rotavg_ros.solver.slam.graph.evenly import evenly
from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.left_out import rough_cost
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves.slips import AGREE, AGREE_ANGLE, OPTIMISM, SETTLING
from rotavg_ros.solver.slam.posterior.moves.turning import sides_turned, trusted_after_turn

# Maximum number of false closures of which it is counted how many agree with each.
_MAX_TRIED = 256


def propose_joins(mode: Mode) -> Iterator[Proposal]:
    """Proposes to turn a chain, and all that good closures hang on it, as a group of false closures says."""
    problem, graph, closure = mode.problem, mode.problem.graph, mode.problem.closure
    number = np.unique(graph.chain, return_inverse=True)[1]
    ends = np.stack((number[graph.source[closure]], number[graph.target[closure]]))
    joins = ends[0] != ends[1]
    is_left = joins & mode.is_false & ~np.isinf(problem.log_odds[closure])
    if not is_left.any():
        return
    turned = quaternion_rows.residual(mode.state.correction, problem.measured, graph.source, graph.target)[:, closure]
    turned = np.where(ends[0] < ends[1], turned, quaternion_rows.inverse(turned))
    low, high = np.sort(ends, axis=0)
    variance = mode.state.noise.closure_variance + mode.state.others.predicted[closure]
    before = rough_cost(problem, mode.state)
    for _ in range(problem.limits.candidates):
        if not is_left.any():
            break
        left = np.flatnonzero(is_left)
        tried = evenly(left[np.argsort(problem.detected[left])], _MAX_TRIED)[:, None]
        difference = 2 * np.arccos(np.minimum(np.abs(turned[:, tried[:, 0]].T @ turned), 1.0))
        square = AGREE**2 * problem.components * (variance + variance[tried]) + AGREE_ANGLE**2
        groups = joins & (low == low[tried]) & (high == high[tried]) & (difference**2 < square)
        best = with_most_runs(groups & is_left, problem.run)
        seed, agrees = int(tried[best, 0]), groups[best]
        is_left &= ~agrees
        held = joins & ~mode.is_false & ~((low == low[seed]) & (high == high[seed]) & ~agrees)
        pair = int(low[seed]), int(high[seed])
        for chains in _sides(int(number.max()) + 1, ends, np.flatnonzero(held), problem.run, pair):
            moving, resting = chains[:, number]
            state = sides_turned(mode, moving, resting, turned[:, [seed]])
            state = replace(state, trusted=trusted_after_turn(mode, state))
            predicted = rough_cost(problem, state) - before - OPTIMISM
            yield Proposal("join otherwise", predicted, partial(settle, problem, state, SETTLING), problem.limits.slack)


def _sides(count: int, ends: np.ndarray, held: np.ndarray, run: np.ndarray, pair: tuple[int, int]) -> list[np.ndarray]:
    """``(2, n)`` bool each: of n = ``count`` chains, those that turn against others, and these others.

    If without the pair's own closures no good ones join its two chains, each turns with all that hangs on it. Otherwise
    some of these have to be wrong: those of fewest runs, or all at either of the two, which turns alone.

    Args:
        count: number of chains.
        ends: ``(2, C)`` chains that closures join.
        held: ``(H,)`` good ones, without those between the pair that the turn makes false.
        run: ``(C,)`` the closures' runs.
        pair: lower and higher chain; the higher one turns against the lower one.
    """
    component, part = connected(count, ends.T), connected(count, ends[:, held].T)
    is_near = component == component[pair[0]]
    if part[pair[0]] != part[pair[1]]:
        turning = [part == part[pair[1]]]
    else:
        alone = [np.arange(count) == each for each in pair]
        turning = [*ChainCuts.of(count, ends[:, held].T, run[held]).beyond(*pair), alone[1], ~alone[0]]
    sides = [np.stack((is_near & beyond, is_near & ~beyond)) for beyond in turning]
    return [side for number, side in enumerate(sides) if not any(np.array_equal(side, one) for one in sides[:number])]
