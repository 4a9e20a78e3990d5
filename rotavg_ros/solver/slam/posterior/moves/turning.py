"""Turns a part of the map against the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.graph.chain_cuts import ChainCuts, connected
from rotavg_ros.solver.slam.posterior.left_out import relabelled
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.state import State


def sides_turned(mode: Mode, moving: np.ndarray, resting: np.ndarray, turn: np.ndarray) -> State:
    """The mode's state with one side turned against another one, which turns back instead where the first has a root.

    Args:
        mode: the labelling before.
        moving, resting: ``(K,)`` bool, the sides' key nodes.
        turn: ``(4, 1)`` turn of ``moving``.
    """
    if moving[mode.problem.graph.roots].any():  # roots are fixed
        moving, turn = resting, quaternion_rows.inverse(turn)
    correction = mode.state.correction.copy()
    correction[:, moving] = quaternion_rows.multiply(correction[:, moving], turn)
    return replace(mode.state, correction=correction)


def part_turned(mode: Mode, nodes: np.ndarray, turn: np.ndarray) -> State:
    """The mode's state with a part of a chain, ``(K,)`` bool key nodes, turned by ``turn`` ``(4, 1)``.

    With it turn the chains that good closures hang on it rather than on the chain's rest, by a cut of fewest runs.
    """
    problem, graph = mode.problem, mode.problem.graph
    names, unit = np.unique(graph.chain, return_inverse=True)
    good = problem.closure[~mode.is_false]
    source, target = graph.source[good], graph.target[good]
    joins = graph.chain[source] != graph.chain[target]
    # The part is a unit of its own, the last.
    rest, part = int(unit[np.argmax(nodes)]), len(names)
    unit[nodes] = part
    if not (joins.any() and nodes.any()):
        return sides_turned(mode, nodes, unit == rest, turn)
    ends = unit[np.stack((source, target), axis=1)[joins]]
    component = connected(part + 1, ends)
    is_near = (component == component[rest]) | (component == component[part])
    turns = next(ChainCuts.of(part + 1, ends, problem.run[~mode.is_false][joins]).beyond(rest, part))
    return sides_turned(mode, (turns & is_near)[unit], (~turns & is_near)[unit], turn)


def trusted_after_turn(mode: Mode, state: State, *, may_mend: bool = False) -> np.ndarray:
    """``(E,)`` labels after a part was turned: closures get the label that their residual favours, odometry keeps its.

    Args:
        mode: the labelling before.
        state: the state after the turn.
        may_mend: whether slips that their residual no longer favours become sound.
    """
    odometry, trusted = mode.problem.graph.is_odometry, relabelled(mode.problem, state)
    kept = mode.state.trusted[odometry]
    trusted[odometry] = np.maximum(kept, trusted[odometry]) if may_mend else kept
    return trusted
