"""Moves that let odometry slip where one turn explains false closures, or that take a slip back or shift it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.posterior.densities import log_false
from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.labels.false_closures import Discrepancies, false_density, log_false_set
from rotavg_ros.solver.slam.posterior.labels.prior import log_label_prior, log_slip_odds
from rotavg_ros.solver.slam.posterior.left_out import rough_cost
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves.turning import part_turned, trusted_after_turn
from rotavg_ros.solver.slam.posterior.rows import variances
from rotavg_ros.solver.slam.posterior.state import State

# Number of solves of a move's settling.
SETTLING = 4
# Decrease of F, nats, that relabelling and bending may at most add to what the turned-back residuals predict.
OPTIMISM = 10.0
# A turn explains a closure whose error differs from it by at most this many standard deviations, or this angle, rad.
AGREE, AGREE_ANGLE = 3.0, np.radians(2.0)
# Least number of false closures for a slip: a single one costs less than a slip.
LEAST_WITNESSES = 2
# Largest number of segments by which a slip is shifted.
_FARTHEST_SHIFT = 8
# Positions along the path that differ by less than this, in steps, are the same.
SAME_PLACE = 1e-9


@dataclass(frozen=True)
class Witnesses:
    """Evidence from C closures on slips of S sound segments, which are sorted along the path.

    Attributes:
        turned: ``(4, C)`` residuals of the closures, from older to newer end.
        can_tell: ``(C,)`` bool, whether one chain of odometry has both ends.
        may_be_good: ``(C,)`` bool, those of them that are false and that no user has rejected.
        first, last: ``(C,)`` segments that each closure spans: first ≤ s < last.
        gain: ``(C,)`` nats that each closure gains by being good, relative to being false on its own.
        segment: ``(S,)`` edges.
        price: ``(S,)`` nats, cost of a slip in each on its own.
    """

    turned: np.ndarray
    can_tell: np.ndarray
    may_be_good: np.ndarray
    first: np.ndarray
    last: np.ndarray
    gain: np.ndarray
    segment: np.ndarray
    price: np.ndarray

    @classmethod
    def of(cls, mode: Mode) -> Witnesses:
        problem, state, graph, closure = mode.problem, mode.state, mode.problem.graph, mode.problem.closure
        turned = quaternion_rows.residual(state.correction, problem.measured, graph.source, graph.target)[:, closure]
        turned = np.where(problem.sign > 0, turned, quaternion_rows.inverse(turned))
        can_tell = graph.chain[graph.source[closure]] == graph.chain[graph.target[closure]]
        may_be_good = can_tell & mode.is_false & np.isfinite(problem.log_odds[closure])
        segment = np.flatnonzero(state.is_good[: graph.num_segments])
        start = graph.span[0, segment]
        order = np.argsort(start, kind="stable")
        first, last = np.searchsorted(start[order], problem.ends.T - SAME_PLACE)
        square = (mode.evaluation.residual[closure] ** 2).sum(axis=1)
        alone = log_false(square, problem.components, problem.priors)
        gain = np.maximum(mode.left_out.if_good[closure] - alone, 0.0)
        segment = segment[order]
        return cls(turned, can_tell, may_be_good, first, last, gain, segment, mode.left_out.log_odds[segment])

    def agreeing(self, turn: np.ndarray, mode: Mode) -> np.ndarray:
        """``(C,)`` bool, false closures whose error is about ``turn`` ``(4,)``."""
        tolerance = 2 * AGREE**2 * mode.problem.components * mode.state.noise.closure_variance + AGREE_ANGLE**2
        difference = 2 * np.arccos(np.minimum(np.abs(turn @ self.turned), 1.0))
        return np.asarray((difference**2 < tolerance) & self.may_be_good)

    def best_place(self, agrees: np.ndarray, disagrees: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """Index of the segment where a slip gains most; ``(C,)`` bool, closures it makes good, and ones it makes false.

        Args:
            agrees: ``(C,)`` bool, closures that the turn would make good if they span the slip.
            disagrees: ``(C,)`` bool, closures that it would make false.
        """
        change = np.where(agrees, self.gain, np.where(disagrees, -self.gain, 0.0))
        across = np.zeros(len(self.segment) + 1)
        np.add.at(across, self.first, change)
        np.add.at(across, self.last, -change)
        best = int(np.argmin(self.price - np.cumsum(across)[:-1]))
        is_across = (self.first <= best) & (best < self.last)
        return best, is_across & agrees, is_across & disagrees


def propose_slips(mode: Mode) -> Iterator[Proposal]:
    """Proposes slips where one turn makes at least two false closures good."""
    witnesses = Witnesses.of(mode)
    places = _places(mode, witnesses)[: mode.problem.limits.candidates]
    before = log_labelled(mode, mode.is_false) if places else 0.0
    for _, closure, place, freed, lost in places:
        edge, turn = int(witnesses.segment[place]), witnesses.turned[:, [closure]]
        # Jointly the closures gain less than one by one, since false closures that repeat a turn are cheap.
        labelled = log_labelled(mode, mode.is_false & ~freed)
        labelled += _log_turned(mode, np.flatnonzero(freed), turn, witnesses.turned[:, freed])
        labelled += float(log_slip_odds(mode.problem, mode.problem.graph.own_steps[[edge]], len(mode.slipped))[0])
        predicted = before - labelled + float(witnesses.gain[lost].sum())
        # A slip turns a part of the map, so one that is merely a rival of the best labelling is tried, too.
        yield Proposal("slip", predicted, partial(_with_slip, mode, edge, turn), mode.problem.limits.rival)


def may_have_slipped(mode: Mode) -> bool:
    """Whether some slip would lower F if the closures that it explains did not repeat each other.

    With several slips, none need lower F alone: the closures that reveal the others are still labelled false, and they
    are cheap because they repeat each other's turn.
    """
    return any(gained > 0 for gained, *_ in _places(mode, Witnesses.of(mode))) or any(
        slip.predicted <= slip.slack for slip in propose_slips(mode)
    )


def _places(mode: Mode, witnesses: Witnesses) -> list[tuple[float, int, int, np.ndarray, np.ndarray]]:
    """Candidate slips, by predicted gain, the largest first.

    Returns:
        For each: gain in nats, each closure counted independently; the closure whose residual is the turn; index of the
        segment; ``(C,)`` bool, closures it makes good, and those it makes false.
    """
    left, found = witnesses.may_be_good.copy(), []
    disagrees = witnesses.can_tell & ~mode.is_false
    for closure in np.flatnonzero(left if len(witnesses.segment) else np.zeros_like(left)):
        if left[closure]:
            agrees = witnesses.agreeing(witnesses.turned[:, closure], mode)
            left &= ~agrees
            place, freed, lost = witnesses.best_place(agrees, disagrees)
            gained = float(witnesses.gain[freed].sum() - witnesses.gain[lost].sum() - witnesses.price[place])
            if freed.sum() >= LEAST_WITNESSES:
                found.append((gained, int(closure), place, freed, lost))
    return sorted(found, key=lambda slip: -slip[0])


def _log_turned(mode: Mode, members: np.ndarray, turn: np.ndarray, turned: np.ndarray) -> float:
    """Log density, nats, of K false closures if they are good and one slip turned all of them by about ``turn``.

    The turn is removed before logarithms are taken: near half a turn, differences of rotation vectors are up to π/2
    times as long as the rotations between them.

    Args:
        mode: the labelling at its optimum.
        members: ``(K,)`` closures.
        turn: ``(4, 1)``.
        turned: ``(4, K)`` their residuals, from older to newer end.
    """
    problem, k = mode.problem, mode.problem.components
    rows, sign, slip = problem.closure[members], problem.sign[members], np.radians(problem.priors.slip_deg)
    residual = quaternion_rows.log(quaternion_rows.multiply(quaternion_rows.inverse(turn), turned)).T
    total = mode.covariance_of(members) + np.diag(variances(problem, mode.state.noise)[rows])
    total = total * np.outer(sign, sign) + slip**2
    square = float((residual * np.linalg.solve(total, residual)).sum())
    square += float((quaternion_rows.log(turn) ** 2).sum()) / slip**2
    log_det = float(np.linalg.slogdet(total)[1])
    return float(-square / 2 - k / 2 * (log_det + len(rows) * np.log(2 * np.pi)))


def log_labelled(mode: Mode, is_false: np.ndarray, residual: np.ndarray | None = None) -> float:
    """Log density, nats, of the false closures and of all labels.

    Args:
        mode: the labelling at its optimum.
        is_false: ``(C,)`` bool, labels.
        residual: ``(C, 3)`` rad, from source to target; default: those of ``mode``.
    """
    problem = mode.problem
    off = Discrepancies.of(problem, mode.state, mode.evaluation.residual)
    off = off if residual is None else off._replace(residual=residual)
    density = false_density(problem, is_false, off, np.flatnonzero(is_false))
    return log_false_set(problem, density) + log_label_prior(problem, is_false)


def propose_mending(mode: Mode) -> Iterator[Proposal]:
    """Proposes to take each slip back: turn all behind it, or the part up to the next slip, or let odometry bend."""
    yield from propose_turning_back(mode, mode.slipped)
    for edge in mode.slipped[: mode.problem.limits.candidates]:
        bends = -float(mode.left_out.log_odds[edge])
        bend = partial(_bent, mode, int(edge))
        yield Proposal("mend and bend", bends - OPTIMISM, bend, mode.problem.limits.slack)


def propose_turning_back(mode: Mode, slipped: np.ndarray) -> Iterator[Proposal]:
    """Proposes to take each of some slips back by turning all behind it, or the part up to the next one."""
    before, slack = rough_cost(mode.problem, mode.state), mode.problem.limits.slack
    for number, edge in enumerate(slipped[: mode.problem.limits.candidates]):
        following = int(slipped[number + 1]) if number + 1 < len(slipped) else None
        for name, end in (("mend and reject", None), ("turn a part back", following)):
            if end is not None or name == "mend and reject":
                state = _mended(mode, int(edge), end)
                predicted = rough_cost(mode.problem, state) - before - OPTIMISM
                yield Proposal(name, predicted, partial(settle, mode.problem, state, SETTLING), slack)


def propose_shifts(mode: Mode) -> Iterator[Proposal]:
    """Proposes to shift each slip to a sound segment of its chain, up to ``_FARTHEST_SHIFT`` before or after it.

    Not only to the adjacent ones: a closure between two segments may contradict the nearer one. Also, places, which
    rotations do not know, may later choose among these rivals.
    """
    graph, limits = mode.problem.graph, mode.problem.limits
    segment = np.flatnonzero(graph.is_odometry[: graph.num_segments])
    order = segment[np.argsort(graph.span[0, segment], kind="stable")]
    chain = graph.chain[graph.source]
    before = rough_cost(mode.problem, mode.state)
    slipped = mode.slipped[mode.slipped < graph.num_segments]
    for edge in slipped[: limits.candidates]:
        (at,) = np.flatnonzero(order == edge)
        for place in (at + side * far for far in range(1, _FARTHEST_SHIFT + 1) for side in (-1, 1)):
            other = int(order[place]) if 0 <= place < len(order) else -1
            if other >= 0 and mode.state.is_good[other] and chain[other] == chain[edge]:
                state = _shifted(mode, int(edge), other, is_later=place > at)
                predicted = rough_cost(mode.problem, state) - before
                yield Proposal("shift", predicted, partial(settle, mode.problem, state, SETTLING), limits.rival)


def _with_slip(mode: Mode, edge: int, turn: np.ndarray) -> State:
    state = part_turned(mode, mode.problem.graph.behind(edge), turn)
    trusted = trusted_after_turn(mode, state)
    trusted[edge] = 0.0
    return settle(mode.problem, replace(state, trusted=trusted), SETTLING)


def _turn_of(mode: Mode, edge: int) -> np.ndarray:
    """``(4, 1)`` turn of everything behind a segment that makes the segment's residual zero."""
    graph, pair = mode.problem.graph, np.array([edge])
    turn = quaternion_rows.residual(
        mode.state.correction, mode.problem.measured[:, pair], graph.source[pair], graph.target[pair]
    )
    is_backward = graph.position[graph.source[edge]] > graph.position[graph.target[edge]]
    return quaternion_rows.inverse(turn) if is_backward else turn


def _shifted(mode: Mode, edge: int, other: int, *, is_later: bool) -> State:
    turn = _turn_of(mode, edge)
    behind, behind_other = (mode.problem.graph.behind(each) for each in (edge, other))
    if is_later:
        state = part_turned(mode, behind & ~behind_other, turn)
    else:
        state = part_turned(mode, behind_other & ~behind, quaternion_rows.inverse(turn))
    trusted = trusted_after_turn(mode, state)
    trusted[edge], trusted[other] = 1.0, 0.0
    return replace(state, trusted=trusted)


def _mended(mode: Mode, edge: int, following: int | None) -> State:
    graph = mode.problem.graph
    nodes = graph.behind(edge)
    if following is not None:
        nodes &= ~graph.behind(following)
    state = part_turned(mode, nodes, _turn_of(mode, edge))
    trusted = trusted_after_turn(mode, state, may_mend=True)
    trusted[edge] = 1.0
    return replace(state, trusted=trusted)


def _bent(mode: Mode, edge: int) -> State:
    trusted = mode.state.trusted.copy()
    trusted[edge] = 1.0
    return settle(mode.problem, replace(mode.state, trusted=trusted), SETTLING)
