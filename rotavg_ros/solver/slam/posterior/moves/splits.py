"""Moves that turn the part between a slip and another segment: one slip was in fact two, or is many segments away.

The parts beyond both ends are already right. So turning everything behind a segment does not explain the closures from
the part in between, and no single slip gains from them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.left_out import rough_cost
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves.slips import (
    LEAST_WITNESSES,
    OPTIMISM,
    SAME_PLACE,
    SETTLING,
    Witnesses,
)
from rotavg_ros.solver.slam.posterior.moves.turning import part_turned, trusted_after_turn
from rotavg_ros.solver.slam.posterior.state import State


@dataclass(frozen=True)
class _Part:
    """The part between a slip and a sound segment before or after it.

    Attributes:
        gained: nats, each closure counted independently, minus the cost of a slip in that segment.
        slip, segment: edges.
        turn: ``(4, 1)`` by which the part is to be turned.
    """

    gained: float
    slip: int
    segment: int
    turn: np.ndarray


class _Group(NamedTuple):
    """False closures that one turn or its inverse explains.

    Attributes:
        turn, inverse: ``(4, 1)`` error of the first of them, and its inverse.
        off, back: ``(C,)`` bool, closures whose error is about the turn, and those whose error is about its inverse.
    """

    turn: np.ndarray
    inverse: np.ndarray
    off: np.ndarray
    back: np.ndarray


def propose_splits(mode: Mode) -> Iterator[Proposal]:
    """Proposes to turn parts beside slips, those with the largest gain first."""
    slipped = mode.slipped[mode.slipped < mode.problem.graph.num_segments]
    if len(slipped) == 0 or mode.is_false.sum() < LEAST_WITNESSES:
        return
    limits, witnesses, before = mode.problem.limits, Witnesses.of(mode), rough_cost(mode.problem, mode.state)
    groups = list(_groups(mode, witnesses))
    parts = [part for slip in slipped[: limits.candidates] for part in _parts(mode, witnesses, groups, int(slip))]
    for part in sorted(parts, key=lambda part: -part.gained)[: limits.candidates]:
        state = _split(mode, part)
        predicted = rough_cost(mode.problem, state) - before - OPTIMISM
        yield Proposal("split", predicted, partial(settle, mode.problem, state, SETTLING), limits.slack)


def _groups(mode: Mode, witnesses: Witnesses) -> Iterator[_Group]:
    """Groups of at least two false closures that one turn or its inverse explains."""
    left = witnesses.may_be_good.copy()
    for number in np.flatnonzero(left):
        if left[number]:
            turn = witnesses.turned[:, [number]]
            inverse = quaternion_rows.inverse(turn)
            off, back = (witnesses.agreeing(each[:, 0], mode) for each in (turn, inverse))
            left &= ~(off | back)
            if (off | back).sum() >= LEAST_WITNESSES:
                yield _Group(turn, inverse, off, back)


def _parts(mode: Mode, witnesses: Witnesses, groups: list[_Group], slip: int) -> Iterator[_Part]:
    """The part beside a slip with the largest gain, for the turn of each group and for its inverse."""
    graph, ends, segment = mode.problem.graph, mode.problem.ends, witnesses.segment
    chain, (older, newer) = graph.chain[graph.source], graph.span
    end = newer[slip] - SAME_PLACE
    is_later, (older_later, newer_later) = older[segment] >= end, (ends >= end).T
    across = newer_later & ~older_later
    there = witnesses.can_tell & (chain[mode.problem.closure] == chain[slip])
    good = np.where(there & ~mode.is_false, witnesses.gain, 0.0)
    is_elsewhere = chain[segment] != chain[slip]
    for group in groups if len(segment) and not is_elsewhere.all() else ():
        # If the newer end is in the part, the part is turned by the closure's error; if the older one, by its inverse.
        for turn, newer, older in ((group.turn, group.off, group.back), (group.inverse, group.back, group.off)):
            newer_gains, older_gains = (np.where(there & freed, witnesses.gain, 0.0) - good for freed in (newer, older))
            later = _over(witnesses, newer_gains * across, None, witnesses.last)
            later += _over(witnesses, older_gains * older_later, witnesses.first, witnesses.last)
            earlier = _over(witnesses, newer_gains * ~newer_later, witnesses.first, witnesses.last)
            earlier += (older_gains * across).sum() - _over(witnesses, older_gains * across, None, witnesses.first)
            gained = np.where(is_later, later, earlier) - witnesses.price
            gained[is_elsewhere] = -np.inf
            best = int(gained.argmax())
            yield _Part(float(gained[best]), slip, int(segment[best]), turn)


def _over(witnesses: Witnesses, change: np.ndarray, begin: np.ndarray | None, end: np.ndarray) -> np.ndarray:
    """``(S,)`` sums over segments of the changes ``(C,)`` of closures, each from ``begin`` to before ``end`` ``(C,)``.

    Without ``begin``, each closure counts for the segments from ``end`` on.
    """
    total = np.zeros(len(witnesses.segment) + 1)
    if begin is None:
        np.add.at(total, end, change)
    else:
        np.add.at(total, begin, change)
        np.add.at(total, end, -change)
    return np.cumsum(total)[:-1]


def _split(mode: Mode, part: _Part) -> State:
    """The state with the part turned and its segment slipped; the old slip stays one only if its residual says so."""
    graph = mode.problem.graph
    state = part_turned(mode, graph.behind(part.slip) ^ graph.behind(part.segment), part.turn)
    trusted = trusted_after_turn(mode, state, may_mend=True)
    trusted[part.segment] = 0.0
    return replace(state, trusted=trusted)
