"""Closures as evidence on jumps of odometry's position: where each would have the map displaced, and what that gains.

A jump displaces everything behind it along its chain. Other chains that right closures join rest with what precedes
the jump or move with what follows: each part of them that is joined without this chain does what gains more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.graph.chain_cuts import connected
from rotavg_ros.solver.slam.poses.closures import TAILS, given_turn
from rotavg_ros.solver.slam.poses.em.estimate import judge_of
from rotavg_ros.solver.slam.poses.repeats.neighbours import log_places
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.search.discrepancies import discrepancies, own_variances
from rotavg_ros.solver.slam.poses.solved import PoseMode

# Shifts agree if they differ by at most this many standard deviations of their uncertainty.
_AGREE = 3.0
# Minimum number of closures for a jump; a single one is explained equally well by a wrong place, unless accepted.
_LEAST_WITNESSES = 2
_WRONG = 0.5
# Number of bins for the ends of a displaced stretch.
_ENDS = 1000
# Positions along the path that differ by less than this, in steps, are the same.
_SAME_PLACE = 1e-9
# Largest error of a step that jumped, relative to the length that it reports.
AS_FAR = 2.0
# Lower bound of a probability.
_LEAST = 1e-12
# Maximum number of closures whose densities given each other are computed; they take its third power of time.
_MOST_TOGETHER = 200
# Variance of a shift of which nothing is known, over the largest one of closures.
_ANY = 1e3


@dataclass(frozen=True)
class Jump:
    """A jump in a graph of S segments, K key nodes and C closures.

    Attributes:
        segment: the segment that jumps.
        back: the segment that undoes the jump; -1 if none does.
        moved: ``(K,)`` bool, key nodes that are displaced.
        shift: ``(3,)`` metres by which they are.
        gained: nats by which closures become likelier, each judged independently, minus the cost of the jump.
        freed: ``(C,)`` bool, closures that do not fit and that the jump makes right.
    """

    segment: int
    back: int
    moved: np.ndarray
    shift: np.ndarray
    gained: float
    freed: np.ndarray


class Place(NamedTuple):
    """Where a jump is.

    Attributes:
        begin: index of the segment that jumps, sorted along the path.
        end: of the one that undoes it; -1 if none does.
        gained: nats.
        moves: ``(P,)`` bool, the other chains that move with what is behind it.
    """

    begin: int
    end: int
    gained: float
    moves: np.ndarray


class Proposal(NamedTuple):
    """A shift that one of n ends of closures proposes.

    Attributes:
        end: that end.
        alike, opposite: ``(n,)`` bool, wrong ends that the shift makes right, and those that the opposite one does.
        gain: ``(n,)`` nats by which wrong ends become likelier then, at most, or given this one and those before
            (:meth:`Witnesses.gain_given`); others lose it.
    """

    end: int
    alike: np.ndarray
    opposite: np.ndarray
    gain: np.ndarray

    def changed(self, alike: np.ndarray, is_wrong: np.ndarray) -> np.ndarray:
        """``(n,)`` nats: gain of each end (negative: loss) that is displaced, if that makes ``alike`` ones right."""
        return np.where(alike, self.gain, np.where(is_wrong, 0.0, -self.gain))


@dataclass(frozen=True)
class Witnesses:
    """Evidence from n ends of closures on jumps of S segments, which are sorted along the paths of P chains.

    A closure within a chain is there once, by its newer end; one between two chains by either end.

    Attributes:
        pose: the poses that they are judged by.
        closure: ``(n,)`` the closures.
        chain, other: ``(n,)`` chains of this end and of the other one.
        sign: ``(n,)`` 1 for the closure's target, −1 for its source: residuals are displacements of targets.
        shift: ``(n, m)`` metres by which this end would be displaced, according to each.
        spread: ``(n,)`` m² per component, variance of that shift.
        is_wrong: ``(n,)`` bool, closures that are judged to join wrong places, or accepted ones in the tails.
        is_accepted: ``(n,)`` bool, closures that somebody has labelled accepted.
        gain: ``(n,)`` nats that a wrong closure gains by becoming right, each by itself, or that a right one loses by
            becoming wrong.
        held: ``(n,)`` nats, log density of each as it is judged, given those before.
        most: ``(n,)`` nats, upper bound of what each gains given others: where all else predicts it exactly.
        first, last: ``(n,)`` this end is displaced, and the other one not, by jumps in segments first ≤ s < last, if
            other chains rest.
        segment: ``(S,)`` edges of the closure graph.
        begins: ``(P + 1,)`` index of each chain's first segment, and S.
        price: ``(S,)`` nats, cost of a jump in each; 0 if it jumps already.
        variance: ``(S,)`` m² per component, prior variance of a jump in each; 0 where there can be none.
        joining: ``(B, 2)`` chains that right closures join.
    """

    pose: PoseMode
    closure: np.ndarray
    chain: np.ndarray
    other: np.ndarray
    sign: np.ndarray
    shift: np.ndarray
    spread: np.ndarray
    is_wrong: np.ndarray
    is_accepted: np.ndarray
    gain: np.ndarray
    held: np.ndarray
    most: np.ndarray
    first: np.ndarray
    last: np.ndarray
    segment: np.ndarray
    begins: np.ndarray
    price: np.ndarray
    variance: np.ndarray
    joining: np.ndarray

    @classmethod
    def of(cls, pose: PoseMode, price: float) -> Witnesses:
        """Of poses.

        Args:
            pose: estimated.
            price: nats, minus the log prior of one more jump.
        """
        problem, told, places, drawn = pose.problem, pose.problem.told, pose.solved.places, pose.problem.drawn
        is_right = places.right > _WRONG
        # Where nothing joins two chains otherwise, a closure between them tells of where they lie, not of a jump.
        tells = pose.solved.predictions.tell(problem.turns, pose.solved.scale.extent) & told.joined(is_right)
        can_tell = told.is_known & (told.is_within | tells)
        segments = slice(drawn.num_segments)
        start, chain_of_segment = drawn.span[0, segments], problem.chain_number[drawn.source[segments]]
        order = np.argsort(start, kind="stable")
        begins = np.searchsorted(chain_of_segment[order], np.arange(problem.chain_number.max() + 2))
        end = _Ends.of(pose, np.flatnonzero(can_tell), begins)
        place = np.searchsorted(start[order], np.stack((end.older, end.position)) - _SAME_PLACE)
        first = np.where(end.chain == end.other, place[0], begins[end.chain])
        is_accepted = told.label > 0
        # A label rules wrong places out: where an accepted closure does not fit, it is in the tails.
        is_off = np.where(is_accepted, places.chance[TAILS] > _WRONG, ~is_right) & (told.label >= 0)
        spread = np.trace(pose.solved.predictions.covariance[:, problem.turns :, problem.turns :], axis1=1, axis2=2)
        spread = spread / problem.shifts + stated_variance(problem, pose.state)
        gain, held = _gains(pose, is_off)
        highest = -np.log(2 * np.pi * own_variances(pose, np.arange(len(is_off)))).sum(axis=1) / 2
        most = np.where(is_off, np.maximum(gain, highest - held), gain)
        of_closures = spread, is_off, is_accepted, gain, held, most
        spread, is_off, is_accepted, gain, held, most = (each[end.closure] for each in of_closures)
        joining = told.chains[is_right & ~told.is_within & told.is_known]
        prices, variance = np.where(problem.jumps[order] > 0, 0.0, price), problem.could_jump[order]
        ends = end.closure, end.chain, end.other, end.sign, end.shift
        judged = spread, is_off, is_accepted, gain, held, most
        return cls(pose, *ends, *judged, first, place[1], order, begins, prices, variance, joining)

    def are_enough(self, ends: np.ndarray) -> bool:
        """Whether closures' ends ``(n,)`` bool, if they agree, are evidence for a jump."""
        return len(np.unique(self.closure[ends])) >= _LEAST_WITNESSES or bool((ends & self.is_accepted).any())

    def agreeing(self, proposer: int, sign: float = 1.0) -> np.ndarray:
        """``(n,)`` bool, wrong ends in the proposing one's chain with its shift; with ``sign`` -1, the opposite."""
        square = ((sign * self.shift - self.shift[proposer]) ** 2).sum(axis=1) / self.shift.shape[1]
        is_alike = square < _AGREE**2 * (self.spread + self.spread[proposer])
        return np.asarray(self.is_wrong & is_alike & (self.chain == self.chain[proposer]))

    def proposals(self, end: int) -> list[Proposal]:
        """What one end proposes: that it is displaced; or, between two chains, that what it is judged by is."""
        alike, opposite = self.agreeing(end), self.agreeing(end, -1.0)
        found = [Proposal(end, alike, opposite, self.most), Proposal(end, opposite, alike, self.most)]
        return found[: 1 + int(self.chain[end] != self.other[end])]

    def gain_given(self, end: int) -> np.ndarray:
        """``(n,)`` nats: gains given what one end, which keeps its own, and those before say of the shift.

        What odometry leaves open of where closures lie they share, whether they are right or repeat wrong places.
        """
        # Ends that agree with it, and those that agree about the opposite shift.
        sign = self.agreeing(end).astype(np.float64) - self.agreeing(end, -1.0)
        told, shifts, first = self.pose.problem.told, self.pose.problem.shifts, self.closure[end]
        ends = np.flatnonzero((sign != 0) & ~self.is_accepted & (self.closure != first))
        ends = ends[np.argsort(told.detected[self.closure[ends]], kind="stable")][:_MOST_TOGETHER]
        members = np.append(first, self.closure[ends])
        total, off = discrepancies(self.pose, members)
        d = len(off) // len(members)
        # The shift itself may be any.
        moved = np.zeros((len(members), d, shifts))
        moved[:, d - shifts :] = np.append(self.sign[end], (sign * self.sign)[ends])[:, None, None] * np.eye(shifts)
        by_shift = moved.reshape(-1, shifts)
        largest = float(total.diagonal().max())
        total = total + _ANY * largest * by_shift @ by_shift.T
        # Steps of a hundred kilometres leave less than rounding of what closures err by themselves.
        total[np.diag_indices(len(total))] += len(total) * np.finfo(np.float64).eps * _ANY * largest
        root = np.linalg.cholesky(total)
        white = solve_triangular(root, off, lower=True)
        log_density = -(white**2 / 2 + np.log(np.sqrt(2 * np.pi) * root.diagonal())).reshape(-1, d).sum(axis=1)
        gain = self.gain.copy()
        gain[ends] = np.maximum(log_density[1:] - self.held[ends], 0.0)
        return np.asarray(gain)

    def place(self, proposal: Proposal) -> Place:
        """The segment where a jump gains most; nothing undoes it."""
        rest()
        proposer = proposal.end
        chain = int(self.chain[proposer])
        begins, count = int(self.begins[chain]), int(np.diff(self.begins)[chain])
        first, last, change = self.first - begins, self.last - begins, proposal.changed(proposal.alike, self.is_wrong)
        inside = self._within(chain)
        gained = _spanned(np.zeros(inside.sum(), dtype=int), (first[inside], last[inside]), change[inside], (1, count))[
            0
        ]
        # Either a part of the other chains rests, or it moves with what is behind the jump.
        joins = (self.chain == chain) & ~inside
        parts = connected(len(self.begins) - 1, self.joining[(self.joining != chain).all(axis=1)])
        names, part = np.unique(parts[self.other[joins]], return_inverse=True)
        shape = len(names), count
        resting = _spanned(part, (first[joins], last[joins]), change[joins], shape)
        until_end = last[joins], np.full(len(part), count)
        moving = _spanned(part, until_end, proposal.changed(proposal.opposite, self.is_wrong)[joins], shape)
        gained = gained + np.maximum(resting, moving).sum(axis=0) - self._prices(proposer)
        best = int(np.argmax(gained))
        moves = np.isin(parts, names[moving[:, best] > resting[:, best]])
        moves[chain] = False
        return Place(begins + best, -1, float(gained[best]), moves)

    def stretch(self, proposal: Proposal) -> Place:
        """The displaced stretch of a chain that gains most; all other chains rest.

        Ends in the stretch have the proposed shift if their others are before it, the opposite one if these are behind
        it. Two-dimensional prefix sums over both give the gain of all begins and ends at once.
        """
        rest()
        proposer = proposal.end
        chain = int(self.chain[proposer])
        begins, count = int(self.begins[chain]), int(np.diff(self.begins)[chain])
        bins = np.minimum(np.arange(count + 1) * _ENDS // max(count, _ENDS), _ENDS)
        # Each bin is represented by its cheapest segment.
        price_of = self._prices(proposer)
        segment = np.lexsort((price_of, bins[:-1]))
        segment = segment[np.unique(bins[:-1][segment], return_index=True)[1]]
        shape = len(segment) + 1, len(segment) + 1
        told = np.flatnonzero(self.chain == chain)
        older, newer = bins[self.first[told] - begins], bins[self.last[told] - begins]
        told, older, newer = (each[older != newer] for each in (told, older, newer))
        into, out = np.zeros(shape), np.zeros(shape)
        changed, back = (proposal.changed(each, self.is_wrong) for each in (proposal.alike, proposal.opposite))
        np.add.at(into, (older, newer), changed[told])
        np.add.at(out, (older, newer), np.where(self._within(chain), back, 0.0)[told])
        # Segment s lies between places s and s + 1: older ≤ a < newer ≤ b, and a < older ≤ b < newer.
        before = into.cumsum(axis=0).cumsum(axis=1)
        after = out.cumsum(axis=0)
        after = after.sum(axis=1, keepdims=True) - after.cumsum(axis=1)
        price = np.append(price_of[segment], 0.0)
        gained = before - after + (np.diagonal(after) - price)[None, :] - (np.diagonal(before) + price)[:, None]
        gained = np.where(np.tri(len(price), dtype=bool), -np.inf, gained)[:-1]
        first, last = (int(each) for each in np.unravel_index(int(np.argmax(gained)), gained.shape))
        undone = begins + int(segment[last]) if last < len(segment) else -1
        moves = np.zeros(len(self.begins) - 1, dtype=bool)
        return Place(begins + int(segment[first]), undone, float(gained[first, last]), moves)

    def jump(self, proposal: Proposal, place: Place) -> Jump:
        """The jump by a proposed shift, at the given place."""
        pose, problem, chain = self.pose, self.pose.problem, int(self.chain[proposal.end])
        other = np.where(self._within(chain), _inside(self.first, place), place.moves[self.other])
        this = _inside(self.last, place)
        into, out = this & ~other & proposal.alike, other & ~this & proposal.opposite
        freed = np.zeros(len(problem.told.label), dtype=bool)
        freed[self.closure[into | out]] = True
        weight = (into.astype(np.float64) - out) / self.spread
        shift = (weight @ self.shift) / max(float(np.abs(weight).sum()), np.finfo(np.float64).tiny)
        back = -1 if place.end < 0 else int(self.segment[place.end])
        # If these closures are right, wrong places are also less common among all others.
        told, priors, chance = problem.told, problem.priors, pose.solved.places.chance
        gained = place.gained + log_places(_right(chance, freed), told, priors) - log_places(chance, told, priors)
        segment = int(self.segment[place.begin])
        moved = problem.drawn.behind(segment) | place.moves[problem.chain_number]
        if back >= 0:
            moved &= ~problem.drawn.behind(back)
        if moved[problem.drawn.roots].any():
            # What holds the frame rests, and all that it is joined with moves the other way.
            joined = connected(len(self.begins) - 1, self.joining)
            moved, shift = (joined == joined[chain])[problem.chain_number] & ~moved, -shift
        return Jump(segment, back, moved, problem.bases[1] @ shift, gained, freed)

    def _within(self, chain: int) -> np.ndarray:
        """``(n,)`` bool, ends of closures within a chain."""
        return np.asarray((self.chain == chain) & (self.other == chain))

    def _prices(self, proposer: int) -> np.ndarray:
        """``(s,)`` nats, cost of a jump by the shift that one end proposes, in each segment of its chain.

        That closure determines the shift, so the cost includes the ratio of the shift's prior to its posterior width.
        """
        segments = slice(*self.begins[self.chain[proposer] + np.arange(2)])
        price, variance = self.price[segments], self.variance[segments]
        square, known = float((self.shift[proposer] ** 2).sum()), float(self.spread[proposer])
        width = self.shift.shape[1] * np.log1p(variance / known) / 2
        # Shortest shift that is compatible with its uncertainty.
        least = max(np.sqrt(square) - _AGREE * np.sqrt(self.shift.shape[1] * known), 0.0)
        could = (variance > 0) & (least**2 <= AS_FAR**2 * variance)
        off = np.full(len(variance), np.inf)
        off[could] = square / (2 * variance[could])
        return np.asarray(np.where(price > 0, price + off + width, 0.0))


class _Ends(NamedTuple):
    """Ends of closures, n, as :class:`Witnesses` has them.

    Attributes:
        closure, chain, other, sign, shift: as there.
        position, older: ``(n,)`` steps along the path: of this end, and of the older one of a closure within a chain.
    """

    closure: np.ndarray
    chain: np.ndarray
    other: np.ndarray
    sign: np.ndarray
    shift: np.ndarray
    position: np.ndarray
    older: np.ndarray

    @classmethod
    def of(cls, pose: PoseMode, closures: np.ndarray, begins: np.ndarray) -> _Ends:
        """Of some closures ``(m,)``, in chains with segments; ``begins``: index of each chain's first segment."""
        problem, told = pose.problem, pose.problem.told
        is_within = told.is_within[closures]
        within, between = closures[is_within], closures[~is_within]
        closure = np.concatenate((within, between, between))
        this = np.concatenate((told.sign[within] > 0, np.ones(len(between)), np.zeros(len(between)))).astype(np.int64)
        chains = told.chains[closure]
        row, drawn = np.arange(len(closure)), problem.drawn
        edge = problem.mode.problem.closure[closure]
        position = drawn.position[np.stack((drawn.source[edge], drawn.target[edge]), axis=1)]
        sign = 2.0 * this - 1
        shift = sign[:, None] * pose.solved.predictions.mean[closure, problem.turns :]
        chain, other = chains[row, this], chains[row, 1 - this]
        ends = closure, chain, other, sign, shift, position[row, this], position[row, 1 - this]
        has_segments = np.diff(begins)[chain] > 0
        return cls(*(each[has_segments] for each in ends))


def _gains(pose: PoseMode, is_off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(C,)`` nats each: what closures that are off gain by becoming right, and others lose by becoming wrong; held.

    A jump that removes a wrong closure's offset gives it at least its density in place without an error.
    """
    problem, solved = pose.problem, pose.solved
    here = given_turn(solved.predictions, problem.told.rotation_variance, problem.turns)
    total = here.spread + stated_variance(problem, pose.state)[:, None]
    log_here = here.log_turn - np.log(2 * np.pi * total).sum(axis=1) / 2
    # In order of detection, since closures that agree would otherwise support each other's wrong places.
    judged = judge_of(problem)(solved.predictions, solved.maps, solved.places.chance, solved.scale, in_order=True)
    lost = -np.log(np.maximum(1 - solved.places.right, _LEAST))
    held = judged.log_density
    return np.maximum(np.where(is_off, log_here - held, lost), 0.0), held


def _spanned(
    rows: np.ndarray, span: tuple[np.ndarray, np.ndarray], change: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """``(r, s)`` sums over n spans that include each of s segments, first ≤ s < last, in r rows.

    Args:
        rows: ``(n,)`` row of each.
        span: ``(n,)`` each, first and last.
        change: ``(n,)`` to be summed.
        shape: r and s.
    """
    sums = np.zeros((shape[0], shape[1] + 1))
    np.add.at(sums, (rows, span[0]), change)
    np.add.at(sums, (rows, span[1]), -change)
    return np.asarray(sums.cumsum(axis=1)[:, :-1])


def _inside(index: np.ndarray, place: Place) -> np.ndarray:
    """``(n,)`` bool, whether what is at an index along the path is displaced."""
    return np.asarray((index > place.begin) & ((place.end < 0) | (index <= place.end)))


def _right(chance: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """``(J + 1, C)`` class probabilities with some closures certainly at right places."""
    changed = np.where(closures, 0.0, chance)
    changed[0] += closures
    return changed
