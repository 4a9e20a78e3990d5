"""Odometry whose position jumps although its heading does not: spinning wheels, a tracker that relocalises elsewhere.

Such a step is wrong by about the length that it reports, and a segment by its longest step. Closures across the jump
then seem to join wrong places, all by the same shift of the world. If one jump, or a jump and a second one that undoes
it, explains enough of them to outweigh its cost, poses are estimated again with it, and −log p decides, as between any
two labellings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.poses.closures import TAILS, given_turn
from rotavg_ros.solver.slam.poses.em.estimate import judge_of
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.repeats.neighbours import log_places
from rotavg_ros.solver.slam.poses.row_errors import stated_variance
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.labels.prior import log_slip_prior

# Shifts agree if they differ by at most this many standard deviations of their uncertainty.
_AGREE = 3.0
# Minimum number of closures for a jump; a single one is explained equally well by a wrong place, unless accepted.
_LEAST_WITNESSES = 2
_WRONG = 0.5
# Maximum number of shifts that are examined, those proposed by the closures of largest gain first; number of these for
# which displaced stretches are examined as well; and number of bins for the ends of a stretch.
_LOOKED_AT, _STRETCHES, _ENDS = 48, 4, 1000
# Positions along the path that differ by less than this, in steps, are the same.
_SAME_PLACE = 1e-9
# Largest error of a step that jumped, relative to the length that it reports.
_AS_FAR = 2.0
# Lower bound of a probability.
_LEAST = 1e-12


def log_jump_prior(problem: PoseProblem) -> float:
    """Log prior, nats, of the set of jumps: as rare as slips, each in the longest step of its segment."""
    jumped = np.flatnonzero(problem.jumps)
    any_step = np.log(np.maximum(problem.drawn.own_steps[jumped], 1.0))
    return log_slip_prior(problem.mode.problem, jumped) - float(any_step.sum())


@dataclass(frozen=True)
class Jump:
    """A jump in a graph of S segments and C closures.

    Attributes:
        segment: the segment that jumps.
        back: the segment that undoes the jump; -1 if none does.
        shift: ``(3,)`` metres by which everything behind the jump, up to ``back``, is displaced.
        gained: nats by which closures become likelier, each judged independently, minus the cost of the jump.
        freed: ``(C,)`` bool, closures that do not fit and that the jump makes right.
    """

    segment: int
    back: int
    shift: np.ndarray
    gained: float
    freed: np.ndarray


def likeliest_jump(pose: PoseMode) -> Jump | None:
    """The jump of largest predicted gain; None if none makes at least two closures right, or an accepted one."""
    witnesses = _Witnesses.of(pose)
    proposers: list[int] = []
    left = witnesses.is_wrong.copy()
    while witnesses.are_enough(left) and len(proposers) < _LOOKED_AT:
        # The closure of largest gain proposes the next shift; those that agree with it need not propose theirs.
        proposers.append(int(np.argmax(np.where(left, witnesses.gain, -1.0))))
        left &= ~witnesses.agreeing(proposers[-1])
    best = witnesses.best([witnesses.jump(pose, proposer, witnesses.place(proposer)) for proposer in proposers])
    if best is not None and best.gained > 0:
        return best
    several = [witnesses.jump(pose, proposer, witnesses.stretch(proposer)) for proposer in proposers[:_STRETCHES]]
    return witnesses.best([jump for jump in (best, *several) if jump is not None])


def with_jump(pose: PoseMode, jump: Jump) -> tuple[PoseProblem, PoseStart]:
    """The problem with one more jump, and a start with everything behind it displaced and the freed closures believed.

    If the jump is undone, only what lies in between is displaced.
    """
    problem, state = pose.problem, pose.state
    shifted = problem.drawn.behind(jump.segment)
    if jump.back >= 0:
        shifted &= ~problem.drawn.behind(jump.back)
    ends = [segment for segment in (jump.segment, jump.back) if segment >= 0]
    variance = np.zeros(problem.graph.num_edges) if problem.jump is None else problem.jump.copy()
    variance[problem.longest_steps[ends]] = problem.could_jump[ends]
    state = replace(state, position=state.position + shifted[:, None] * jump.shift)
    start = PoseStart.believing(pose, np.flatnonzero(jump.freed))
    return replace(problem, jump=variance), replace(start, state=state)


def without_odd_jumps(pose: PoseMode) -> PoseProblem | None:
    """The problem without jumps that are too small to matter or longer than any step allows; None if there are none."""
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
    """Whether any jump is longer than the longest step of its segment allows."""
    return bool(_is_too_far(pose, np.flatnonzero(pose.problem.jumps)).any())


def _is_too_far(pose: PoseMode, segments: np.ndarray) -> np.ndarray:
    """``(n,)`` bool: whether segments jump by more than ``_AS_FAR`` times the length of their longest step."""
    square = (_jumped_by(pose, segments) ** 2).sum(axis=1)
    return np.asarray(square > _AS_FAR**2 * pose.problem.could_jump[segments])


def _jumped_by(pose: PoseMode, segments: np.ndarray) -> np.ndarray:
    """``(n, 3)`` metres: displacement of segments by odometry minus that between the estimated poses of their ends."""
    problem, drawn, position = pose.problem, pose.problem.drawn, pose.state.position
    way = problem.displacements(problem.orientations(pose.state)).displacement[segments]
    return np.asarray(way - (position[drawn.target[segments]] - position[drawn.source[segments]]))


def jump_warnings(pose: PoseMode) -> tuple[str, ...]:
    """A warning that odometry's position jumped, or none."""
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
        f"Odometry's position seems to have jumped {times} while its heading did not, by up to {far[largest]:.1f} m "
        f"(between nodes {first} and {last}): closures on both sides agree on that. Wheels may have spun, or a tracker "
        "may have been lost.",
    )


@dataclass(frozen=True)
class _Witnesses:
    """Evidence from C closures on jumps of S segments, which are sorted along the path.

    Attributes:
        shift: ``(C, m)`` metres by which everything behind the jump would be displaced, according to each closure.
        spread: ``(C,)`` m² per component, variance of that shift.
        is_wrong: ``(C,)`` bool, closures that are judged to join wrong places, or accepted ones in the tails.
        is_accepted: ``(C,)`` bool, closures that somebody has labelled accepted.
        gain: ``(C,)`` nats that a wrong closure gains by becoming right, or that a right one loses by becoming wrong.
        first, last: ``(C,)`` segments that each closure spans: first ≤ s < last; none if no odometry joins its ends.
        segment: ``(S,)`` edges of the closure graph.
        price: ``(S,)`` nats, cost of a jump in each; 0 if it jumps already.
        variance: ``(S,)`` m² per component, prior variance of a jump in each; 0 where there can be none.
    """

    shift: np.ndarray
    spread: np.ndarray
    is_wrong: np.ndarray
    is_accepted: np.ndarray
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
        own = stated_variance(problem, pose.state)
        total = here.spread + own[:, None]
        log_here = here.log_turn - np.log(2 * np.pi * total).sum(axis=1) / 2
        places = solved.places
        can_tell = told.is_known & (drawn.chain[drawn.source] == drawn.chain[drawn.target])[mode.closure]
        # A label rules wrong places out: where an accepted closure does not fit, it is in the tails.
        is_accepted = told.label > 0
        is_off = np.where(is_accepted, places.chance[TAILS] > _WRONG, places.right < _WRONG)
        is_wrong = is_off & can_tell & (told.label >= 0)
        # A jump that removes a wrong closure's offset gives it at least the density log_here; a right closure that is
        # displaced loses its right place.
        judge = judge_of(problem)
        # In order of detection, since closures that agree would otherwise support each other's wrong places.
        held = judge(solved.predictions, solved.maps, places.chance, solved.scale, in_order=True).log_density
        freed, lost = log_here - held, -np.log(np.maximum(1 - places.right, _LEAST))
        gain = np.where(can_tell, np.maximum(np.where(is_wrong, freed, lost), 0.0), 0.0)
        start = drawn.span[0, : drawn.num_segments]
        order = np.argsort(start, kind="stable")
        first, last = np.searchsorted(start[order], mode.ends.T - _SAME_PLACE)
        last = np.where(can_tell, last, first)
        # A jump has the same prior in every segment, so segment 0 stands for the next one.
        another = np.append(np.flatnonzero(problem.jumps), 0)
        price = log_jump_prior(problem) - log_slip_prior(mode, another)
        price += float(np.log(np.maximum(drawn.own_steps[another], 1.0)).sum())
        jumps = problem.jumps[order] > 0
        variance = problem.could_jump[order]
        shift = told.sign[:, None] * solved.predictions.mean[:, k:]
        spread = np.trace(solved.predictions.covariance[:, k:, k:], axis1=1, axis2=2) / problem.shifts
        closures = shift, spread + own, is_wrong, is_accepted, gain, first, last
        return cls(*closures, order, np.where(jumps, 0.0, price), variance)

    def are_enough(self, closures: np.ndarray) -> bool:
        """Whether closures ``(C,)`` bool, if they agree, are evidence for a jump."""
        return bool(closures.sum() >= _LEAST_WITNESSES or (closures & self.is_accepted).any())

    def best(self, jumps: list[Jump]) -> Jump | None:
        """The jump of largest predicted gain among those for which there is evidence; None if there are none."""
        told = [jump for jump in jumps if self.are_enough(jump.freed)]
        return max(told, key=lambda jump: jump.gained, default=None)

    def agreeing(self, proposer: int, sign: float = 1.0) -> np.ndarray:
        """``(C,)`` bool, wrong closures with the same shift as the proposing one; with ``sign`` -1, the opposite."""
        square = ((sign * self.shift - self.shift[proposer]) ** 2).sum(axis=1) / self.shift.shape[1]
        return np.asarray(self.is_wrong & (square < _AGREE**2 * (self.spread + self.spread[proposer])))

    def place(self, proposer: int) -> tuple[int, int, float]:
        """Index of the segment where the jump that one closure proposes gains most; -1: not undone; gain in nats."""
        rest()
        change = self._changed(proposer)
        across = np.zeros(len(self.segment) + 1)
        np.add.at(across, self.first, change)
        np.add.at(across, self.last, -change)
        gained = np.cumsum(across)[:-1] - self._price_of(proposer)
        best = int(np.argmax(gained))
        return best, -1, float(gained[best])

    def stretch(self, proposer: int) -> tuple[int, int, float]:
        """The displaced stretch that gains most: indices of the segments that jump and jump back, and gain in nats.

        Closures into the stretch have the proposed shift, closures out of it the opposite one. Two-dimensional prefix
        sums over the closures' ends give the gain of all begins and ends at once.
        """
        rest()
        count = len(self.segment)
        bins = np.minimum(np.arange(count + 1) * _ENDS // max(count, _ENDS), _ENDS)
        older, newer = bins[self.first], bins[self.last]
        # Each bin is represented by its cheapest segment.
        price_of = self._price_of(proposer)
        segment = np.lexsort((price_of, bins[:-1]))
        segment = segment[np.unique(bins[:-1][segment], return_index=True)[1]]
        shape = len(segment) + 1, len(segment) + 1
        told = older != newer
        into, out = np.zeros(shape), np.zeros(shape)
        np.add.at(into, (older[told], newer[told]), self._changed(proposer)[told])
        np.add.at(out, (older[told], newer[told]), self._changed(proposer, -1.0)[told])
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

    def _price_of(self, proposer: int) -> np.ndarray:
        """``(S,)`` nats, cost of a jump by the shift that one closure proposes.

        That closure determines the shift, so the cost includes the ratio of the shift's prior to its posterior width.
        """
        square, known = float((self.shift[proposer] ** 2).sum()), float(self.spread[proposer])
        width = self.shift.shape[1] * np.log1p(self.variance / known) / 2
        # Shortest shift that is compatible with its uncertainty.
        least = max(np.sqrt(square) - _AGREE * np.sqrt(self.shift.shape[1] * known), 0.0)
        could = (self.variance > 0) & (least**2 <= _AS_FAR**2 * self.variance)
        off = np.full(len(self.variance), np.inf)
        off[could] = square / (2 * self.variance[could])
        return np.asarray(np.where(self.price > 0, self.price + off + width, 0.0))

    def _changed(self, proposer: int, sign: float = 1.0) -> np.ndarray:
        """``(C,)`` nats: gain of each closure (negative: loss) if it spans the jump that one closure proposes."""
        return np.asarray(np.where(self.agreeing(proposer, sign), self.gain, np.where(self.is_wrong, 0.0, -self.gain)))

    def jump(self, pose: PoseMode, proposer: int, place: tuple[int, int, float]) -> Jump:
        """The jump that one closure proposes, at the given place: begin, end and gain."""
        begin, end, gained = place
        newer, older = self._inside(self.last, begin, end), self._inside(self.first, begin, end)
        into, out = newer & ~older & self.agreeing(proposer), older & ~newer & self.agreeing(proposer, -1.0)
        freed = into | out
        weight = (into.astype(np.float64) - out) / self.spread
        shift = (weight @ self.shift) / max(float(np.abs(weight).sum()), np.finfo(np.float64).tiny)
        back = -1 if end < 0 else int(self.segment[end])
        # If these closures are right, wrong places are also less common among all others.
        told, priors, chance = pose.problem.told, pose.problem.priors, pose.solved.places.chance
        gained += log_places(_right(chance, freed), told, priors) - log_places(chance, told, priors)
        return Jump(int(self.segment[begin]), back, pose.problem.bases[1] @ shift, gained, freed)

    @staticmethod
    def _inside(place: np.ndarray, begin: int, end: int) -> np.ndarray:
        return np.asarray((place > begin) & ((end < 0) | (place <= end)))


def _right(chance: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """``(J + 1, C)`` class probabilities with some closures certainly at right places."""
    changed = np.where(closures, 0.0, chance)
    changed[0] += closures
    return changed
