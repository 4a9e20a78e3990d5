"""Odometry whose position jumps although its heading does not: spinning wheels, a tracker that relocalises elsewhere.

Such a step is wrong by about the length that it reports, and a segment by its longest step. Closures across the jump
then seem to join wrong places, all by the same shift of the world. If one jump, or a jump and another that takes it
back, explains enough of them to outweigh its cost, poses are estimated anew with it; −log p decides, as between any two
labellings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.poses.closures import given_turn
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.places.judge import Judge
from rotavg_ros.solver.slam.poses.repeats.neighbours import log_places
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.labels.prior import log_slip_prior

# Shifts agree if they differ by at most this many standard deviations of their uncertainty.
_AGREE = 3.0
# Minimum number of closures for a jump; a single one is explained equally well by a wrong place.
_LEAST_WITNESSES = 2
_WRONG = 0.5
# Shifts that are examined, at most, those first that single closures support most; number of these for which stretches
# that lie elsewhere are examined as well; and number of places of either end of a stretch.
_LOOKED_AT, _STRETCHES, _ENDS = 48, 4, 1000
# Positions that differ by less, in steps, are the same.
_SAME_PLACE = 1e-9
# Largest error of a step that jumped, relative to the length that it reports.
_AS_FAR = 2.0
# Lower bound of a probability.
_LEAST = 1e-12


def log_jump_prior(problem: PoseProblem) -> float:
    """Log prior of the set of segments that jumped: as rare as slips, and in their longest steps."""
    jumped = np.flatnonzero(problem.jumps)
    any_step = np.log(np.maximum(problem.drawn.own_steps[jumped], 1.0))
    return log_slip_prior(problem.mode.problem, jumped) - float(any_step.sum())


@dataclass(frozen=True)
class Jump:
    """A jump in a graph of S segments and C closures.

    Attributes:
        segment: that jumps.
        back: another one, before which the jump is taken back; -1 where nothing takes it back.
        shift: ``(3,)`` metres, by which all between lies elsewhere.
        gained: nats, by how much closures are likelier than before, one by one, less what the jump costs.
        freed: ``(C,)`` bool, which come out right.
    """

    segment: int
    back: int
    shift: np.ndarray
    gained: float
    freed: np.ndarray


def likeliest_jump(pose: PoseMode) -> Jump | None:
    """The jump that gains most by what each closure says alone; None if none makes several right."""
    witnesses = _Witnesses.of(pose)
    speakers: list[int] = []
    left = witnesses.is_wrong.copy()
    while left.sum() >= _LEAST_WITNESSES and len(speakers) < _LOOKED_AT:
        # Whoever gains most by itself speaks first; all that agree have been heard then.
        speakers.append(int(np.argmax(np.where(left, witnesses.gain, -1.0))))
        left &= ~witnesses.agreeing(speakers[-1])
    best = _best([witnesses.jump(pose, speaker, witnesses.place(speaker)) for speaker in speakers])
    if best is not None and best.gained > 0:
        return best
    several = [witnesses.jump(pose, speaker, witnesses.stretch(speaker)) for speaker in speakers[:_STRETCHES]]
    return _best([jump for jump in (best, *several) if jump is not None])


def _best(jumps: list[Jump]) -> Jump | None:
    told = [jump for jump in jumps if jump.freed.sum() >= _LEAST_WITNESSES]
    return max(told, key=lambda jump: jump.gained, default=None)


def with_jump(pose: PoseMode, jump: Jump) -> tuple[PoseProblem, PoseStart]:
    """The problem with one jump more, and where its estimate begins: all between elsewhere, closures as freed."""
    problem, state = pose.problem, pose.state
    shifted = _after(problem, jump.segment)
    if jump.back >= 0:
        shifted &= ~_after(problem, jump.back)
    ends = [segment for segment in (jump.segment, jump.back) if segment >= 0]
    variance = np.zeros(problem.graph.num_edges) if problem.jump is None else problem.jump.copy()
    variance[problem.longest_steps[ends]] = problem.could_jump[ends]
    state = replace(state, position=state.position + shifted[:, None] * jump.shift)
    start = PoseStart.believing(pose, np.flatnonzero(jump.freed))
    return replace(problem, jump=variance), replace(start, state=state)


def without_odd_jumps(pose: PoseMode) -> PoseProblem | None:
    """The problem without the jumps that closures need not see, or that no step reports; None if there are none."""
    problem, scale = pose.problem, pose.solved.scale
    jumped = np.flatnonzero(problem.jumps)
    least = problem.priors.least_wrong**2 * problem.shifts * min(scale.closure, scale.extent)
    is_small = (_jumped_by(pose, jumped) ** 2).sum(axis=1) < least
    odd = jumped[is_small | _is_too_far(pose, jumped)]
    if len(odd) == 0 or problem.jump is None:
        return None
    is_odd = np.isin(problem.drawn.segment_of_edge, odd)
    left = np.where(is_odd, 0.0, problem.jump)
    return replace(problem, jump=left if left.any() else None)


def jumps_too_far(pose: PoseMode) -> bool:
    """Whether any jump is one that no step reports."""
    return bool(_is_too_far(pose, np.flatnonzero(pose.problem.jumps)).any())


def _is_too_far(pose: PoseMode, segments: np.ndarray) -> np.ndarray:
    """``(n,)`` bool."""
    square = (_jumped_by(pose, segments) ** 2).sum(axis=1)
    return np.asarray(square > _AS_FAR**2 * pose.problem.could_jump[segments])


def _after(problem: PoseProblem, segment: int) -> np.ndarray:
    """``(K,)`` bool, all that follows a segment along its chain."""
    drawn = problem.drawn
    chain = drawn.paths.chain[drawn.nodes]
    end = drawn.position[[drawn.source[segment], drawn.target[segment]]].max()
    return np.asarray((chain == chain[drawn.source[segment]]) & (drawn.position >= end))


def _jumped_by(pose: PoseMode, segments: np.ndarray) -> np.ndarray:
    """``(n, 3)`` metres, by which segments are longer than what is between their ends."""
    problem, drawn, position = pose.problem, pose.problem.drawn, pose.state.position
    way = problem.displacements(problem.orientations(pose.state)).displacement[segments]
    return np.asarray(way - (position[drawn.target[segments]] - position[drawn.source[segments]]))


def of_jumps(pose: PoseMode) -> tuple[str, ...]:
    """What is to be known of odometry whose position jumped: a sentence, or none."""
    problem, drawn = pose.problem, pose.problem.drawn
    jumped = np.flatnonzero(problem.jumps)
    if len(jumped) == 0:
        return ()
    ends = drawn.source[jumped], drawn.target[jumped]
    far = np.linalg.norm(_jumped_by(pose, jumped), axis=1)
    largest = int(far.argmax())
    first, last = sorted(int(drawn.nodes[end[largest]]) for end in ends)
    times = "once" if len(jumped) == 1 else f"{len(jumped)} times"
    return (
        f"Odometry's position is held to have jumped {times} while its heading did not, the farthest by "
        f"{far[largest]:.1f} m between nodes {first} and {last}, because closures across it agree that it has: wheels "
        "that spun, or a tracker that was lost.",
    )


@dataclass(frozen=True)
class _Witnesses:
    """What closures say of jumps (S segments in the order of the path).

    Attributes:
        shift: ``(C, m)`` metres, by which each would have all that follows elsewhere.
        spread: ``(C,)`` m² per component, to which it knows that.
        is_wrong: ``(C,)`` bool, which are held to join wrong places.
        gain: ``(C,)`` nats, what each of these gains by coming out right, and others lose by coming out wrong.
        first, last: ``(C,)`` segments that each lies across: first ≤ s < last; none where no odometry joins both ends.
        segment: ``(S,)`` edges.
        price: ``(S,)`` nats of a jump of each; nothing where it jumps already.
        variance: ``(S,)`` m² per component, of a jump of each.
    """

    shift: np.ndarray
    spread: np.ndarray
    is_wrong: np.ndarray
    gain: np.ndarray
    first: np.ndarray
    last: np.ndarray
    segment: np.ndarray
    price: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, pose: PoseMode) -> _Witnesses:
        problem, solved = pose.problem, pose.solved
        mode, told, drawn, k = problem.mode.problem, problem.told, problem.drawn, problem.turns
        here = given_turn(solved.predictions, told.rotation_variance, k)
        own = solved.scale.good
        total = here.spread + own[:, None]
        log_here = here.log_turn - np.log(2 * np.pi * total).sum(axis=1) / 2
        places = solved.places
        can_tell = told.is_known & (_chain(problem, drawn.source) == _chain(problem, drawn.target))[mode.closure]
        is_wrong = (places.right < _WRONG) & can_tell & (told.label == 0)
        # Off by nothing it would be as likely as the first, or more; without its right place it is less by the second.
        judge = Judge(told, k, problem.priors)
        # Closures that agree tell each other of their wrong places: together they are as likely as one after the other.
        held = judge(solved.predictions, solved.maps, places.chance, solved.scale, in_order=True).log_density
        freed, lost = log_here - held, -np.log(np.maximum(1 - places.right, _LEAST))
        gain = np.where(can_tell, np.maximum(np.where(is_wrong, freed, lost), 0.0), 0.0)
        start = np.minimum(drawn.position[drawn.source], drawn.position[drawn.target])[: drawn.num_segments]
        order = np.argsort(start, kind="stable")
        first, last = np.searchsorted(start[order], mode.ends.T - _SAME_PLACE)
        last = np.where(can_tell, last, first)
        another = np.append(np.flatnonzero(problem.jumps), 0)
        price = log_jump_prior(problem) - log_slip_prior(mode, another)
        price += float(np.log(np.maximum(drawn.own_steps[another], 1.0)).sum())
        jumps = problem.jumps[order] > 0
        variance = problem.could_jump[order]
        shift = told.sign[:, None] * solved.predictions.mean[:, k:]
        spread = np.trace(solved.predictions.covariance[:, k:, k:], axis1=1, axis2=2) / problem.shifts
        return cls(shift, spread + own, is_wrong, gain, first, last, order, np.where(jumps, 0.0, price), variance)

    def agreeing(self, speaker: int, sign: float = 1.0) -> np.ndarray:
        """``(C,)`` bool, wrong closures that the jump which one speaks of makes right; or the opposite one."""
        square = ((sign * self.shift - self.shift[speaker]) ** 2).sum(axis=1) / self.shift.shape[1]
        return np.asarray(self.is_wrong & (square < _AGREE**2 * (self.spread + self.spread[speaker])))

    def place(self, speaker: int) -> tuple[int, int, float]:
        """Where a jump gains most that makes right what one closure and all that agree say; and what it gains."""
        rest()
        change = self._changed(speaker)
        across = np.zeros(len(self.segment) + 1)
        np.add.at(across, self.first, change)
        np.add.at(across, self.last, -change)
        gained = np.cumsum(across)[:-1] - self._price_of(speaker)
        best = int(np.argmax(gained))
        return best, -1, float(gained[best])

    def stretch(self, speaker: int) -> tuple[int, int, float]:
        """The stretch that gains most if all in it lies elsewhere: where it begins and ends, and what it gains.

        Closures into it say one shift, and those out of it the opposite one. With A and B sums over closures by where
        both ends are, all begins and ends are looked at at once.
        """
        rest()
        count = len(self.segment)
        bins = np.minimum(np.arange(count + 1) * _ENDS // max(count, _ENDS), _ENDS)
        older, newer = bins[self.first], bins[self.last]
        # The likeliest segment of each bin stands for it.
        price_of = self._price_of(speaker)
        segment = np.lexsort((price_of, bins[:-1]))
        segment = segment[np.unique(bins[:-1][segment], return_index=True)[1]]
        shape = len(segment) + 1, len(segment) + 1
        told = older != newer
        into, out = np.zeros(shape), np.zeros(shape)
        np.add.at(into, (older[told], newer[told]), self._changed(speaker)[told])
        np.add.at(out, (older[told], newer[told]), self._changed(speaker, -1.0)[told])
        # Segment s lies between places s and s + 1: older ≤ a < newer ≤ b, and a < older ≤ b < newer.
        before = into.cumsum(axis=0).cumsum(axis=1)
        after = out.cumsum(axis=0)
        after = after.sum(axis=1, keepdims=True) - after.cumsum(axis=1)
        price = np.append(price_of[segment], 0.0)
        gained = before - after + (np.diagonal(after) - price)[None, :] - (np.diagonal(before) + price)[:, None]
        gained = np.where(np.tri(len(price), dtype=bool), -np.inf, gained)[:-1]
        begin, end = np.unravel_index(int(np.argmax(gained)), gained.shape)
        back = int(segment[end]) if end < len(segment) else -1
        return int(segment[begin]), back, float(gained[begin, end])

    def _price_of(self, speaker: int) -> np.ndarray:
        """``(S,)`` nats of a jump by the shift that one closure speaks of.

        The first that speaks tells how far it is, and gains nothing.
        """
        square, known = float((self.shift[speaker] ** 2).sum()), float(self.spread[speaker])
        width = self.shift.shape[1] * np.log1p(self.variance / known) / 2
        off = square / (2 * np.maximum(self.variance, np.finfo(np.float64).tiny))
        # As far as that is known.
        least = max(np.sqrt(square) - _AGREE * np.sqrt(self.shift.shape[1] * known), 0.0)
        off[least**2 > _AS_FAR**2 * self.variance] = np.inf
        return np.asarray(np.where(self.price > 0, self.price + off + width, 0.0))

    def _changed(self, speaker: int, sign: float = 1.0) -> np.ndarray:
        """``(C,)`` nats, what closures gain by the jump that one speaks of, those that lie across it."""
        return np.asarray(np.where(self.agreeing(speaker, sign), self.gain, np.where(self.is_wrong, 0.0, -self.gain)))

    def jump(self, pose: PoseMode, speaker: int, place: tuple[int, int, float]) -> Jump:
        """The jump that one closure implies, at the place where it gains most."""
        begin, end, gained = place
        newer, older = self._inside(self.last, begin, end), self._inside(self.first, begin, end)
        into, out = newer & ~older & self.agreeing(speaker), older & ~newer & self.agreeing(speaker, -1.0)
        freed = into | out
        weight = (into.astype(np.float64) - out) / self.spread
        shift = (weight @ self.shift) / max(float(np.abs(weight).sum()), np.finfo(np.float64).tiny)
        back = -1 if end < 0 else int(self.segment[end])
        # If these are right after all, wrong ones are less common among all others as well.
        told, priors, chance = pose.problem.told, pose.problem.priors, pose.solved.places.chance
        gained += log_places(_right(chance, freed), told, priors) - log_places(chance, told, priors)
        return Jump(int(self.segment[begin]), back, pose.problem.bases[1] @ shift, gained, freed)

    @staticmethod
    def _inside(place: np.ndarray, begin: int, end: int) -> np.ndarray:
        return np.asarray((place > begin) & ((end < 0) | (place <= end)))


def _right(chance: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """``(J + 1, C)`` chances with some closures at right places."""
    changed = np.where(closures, 0.0, chance)
    changed[0] += closures
    return changed


def _chain(problem: PoseProblem, nodes: np.ndarray) -> np.ndarray:
    drawn = problem.drawn
    return np.asarray(drawn.paths.chain[drawn.nodes[nodes]])
