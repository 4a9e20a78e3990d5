"""The search for the labellings of least F: starts, then moves until none promises a gain."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch import Tensor

from rotavg_ros.solver.slam.posterior.em import polish, step
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves import noise, slips
from rotavg_ros.solver.slam.posterior.moves.doubts import propose_doubts
from rotavg_ros.solver.slam.posterior.moves.flips import flipped
from rotavg_ros.solver.slam.posterior.moves.joins import propose_joins
from rotavg_ros.solver.slam.posterior.moves.runs import propose_rejected_runs
from rotavg_ros.solver.slam.posterior.moves.settling import propose_settling
from rotavg_ros.solver.slam.posterior.moves.splits import propose_splits
from rotavg_ros.solver.slam.posterior.moves.starts import starts, turned_further, turned_parts
from rotavg_ros.solver.slam.posterior.moves.tails import hidden_slips, propose_tails
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import with_noise
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.solver.slam.stages import CleanedClosures

# After a gain of this many nats the search leaves the old mode at once: its promising moves exist in the new one too.
_GAIN = 1.0
# Largest decrease of F, nats for each false closure, that is hoped for from further moves once a slip was taken back.
_REGAINED = 0.2
# Number of best modes from which moves are tried.
_BEAM = 3


class Search:
    """Modes of a problem, found by starts and moves.

    Attributes:
        modes: the modes found, in order of increasing F.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.modes: list[Mode] = []
        self._tuned: list[Mode] = []
        self._done: list[Mode] = []
        self._tried = 0

    def run(self, prepared: Prepared, cleaned: CleanedClosures, correction: Tensor) -> None:
        """Runs starts until several end alike, then moves from the best modes until no move is predicted to lower F.

        Args:
            prepared: the contracted graph.
            cleaned: CleanNet's verdict on its closures.
            correction: ``(K, 4)`` corrections of the tree, or of an earlier answer, to begin with.
        """
        begun: list[Mode] = []
        for name, state in starts(self.problem, prepared, cleaned, correction):
            begun.append(self._begun(name, state))
            if sum(mode.is_like(self.modes[0].state) for mode in begun) >= self.problem.limits.alike:
                break
        may_cut = "minimum-cuts" not in self.problem.without and len(prepared.pairs.first) > 0
        from_tree = may_cut and self._seems_slipped(self.modes[0])
        if from_tree:
            self._begun("minimum cuts", turned_parts(self.problem, prepared, correction))
        self.move_on()
        if may_cut and not from_tree and self._seems_slipped(self.modes[0]):  # the moves since have revealed a slip
            self._begun("minimum cuts", turned_parts(self.problem, prepared, correction))
            self.move_on()
        if may_cut:
            self._cut_further(prepared)
        if not self.problem.without & {"slips", "mending"}:
            self._take_back()

    def _cut_further(self, prepared: Prepared) -> None:
        """Minimum cuts from the best mode, as long as they improve it."""
        least = np.inf
        while self.modes[0].cost < least - _GAIN and _has_slipped(best := self.modes[0]):
            least = best.cost
            self._begun("minimum cuts", turned_further(self.problem, prepared, best.state))
            self.move_on()

    def _take_back(self) -> None:
        """Takes slips of the best mode back, each and then all, whatever is predicted, as long as this improves it.

        Behind a slip odometry has bent towards the closures that it made good, so residuals that are turned back as
        they are predict nothing.
        """
        least = np.inf
        while self.modes[0].cost < least - _GAIN and len(taken := _slips(best := self.modes[0])):
            least = best.cost
            mended = [self._doubted(proposal) for proposal in slips.propose_turning_back(best, taken)]
            if self.modes[0].cost > least - _GAIN:
                self._search_from(self._unslipped(min(mended, key=lambda mode: mode.cost)))
            self.move_on()

    def _unslipped(self, mode: Mode) -> Mode:
        """The mode with one slip after the other taken back, while that may still improve the best."""
        for _ in range(self.problem.limits.candidates):
            if len(taken := _slips(mode)) == 0 or self._is_hopeless(mode):
                break
            mode = self._doubted(next(slips.propose_turning_back(mode, taken)))
        return mode

    def _is_hopeless(self, mode: Mode) -> bool:
        return mode.cost > self.modes[0].cost + _REGAINED * int(self.modes[0].is_false.sum())

    def _search_from(self, mode: Mode) -> None:
        """Continues the search from a mode as if it were the best."""
        if self._is_hopeless(mode):
            return
        others, self.modes = self.modes, [mode]
        self.move_on()
        for other in others:
            self.keep(other)

    def _doubted(self, proposal: Proposal) -> Mode:
        """The best of the modes that a proposal leads to, with closures of little evidence doubted."""
        mode = self._made(proposal)
        doubts = () if "doubts" in self.problem.without or self._is_hopeless(mode) else propose_doubts(mode)
        return min((mode, *map(self._made, doubts)), key=lambda mode: mode.cost)

    def _made(self, proposal: Proposal) -> Mode:
        """The mode that a proposal leads to, which is kept."""
        mode = self.flipped(self.polished(proposal.make(), proposal.name))
        self.keep(mode)
        return mode

    def _begun(self, name: str, state: State) -> Mode:
        """The mode of a start, begun with the noise of the best mode so far; the first start estimates its own.

        A start that believes more closures than the best mode may need other noise: while closures across an uneven
        stretch are held false, nothing shows that it is uneven.
        """
        if self.modes:
            best = self.modes[0]
            state = step(self.problem, with_noise(self.problem, state, best.state.noise)).state
            if best.is_turned_like(state):  # labels follow from orientations
                return best
            mode = self.flipped(self.polished(state, name))
            self.keep(mode)
            if mode.is_false.sum() < best.is_false.sum() and mode.cost - noise.promised(mode) < self._farthest:
                self._tune(mode)
            return mode
        mode = self.flipped(self.polished(state, name))
        self.keep(mode)
        uneven = noise.uneven(self.problem, state.noise)
        if uneven != state.noise:
            # If odometry's errors vary along the path, the right labels may not be found with uniform noise.
            self.keep(self.flipped(self.polished(with_noise(self.problem, state, uneven), name)))
        self._tune(self.modes[0])
        return mode

    def _seems_slipped(self, mode: Mode) -> bool:
        if "slips" in self.problem.without:
            return False
        return _has_slipped(mode) or slips.may_have_slipped(mode)

    def move_on(self) -> None:
        """Continues the search from the kept modes."""
        done = self._done
        while (mode := self._next(done)) is not None:
            done.append(mode)
            promising = (proposal for proposal in proposals(mode) if proposal.predicted <= proposal.slack)
            for proposal in sorted(promising, key=lambda proposal: proposal.predicted):
                if self._tried >= self.problem.limits.tried:
                    break
                self._tried += 1
                found = self._made(proposal)
                if found.cost < mode.cost - _GAIN:
                    break
            if self._next(done) is None:
                for near in self._near():
                    self._tune(near)

    def _tune(self, mode: Mode) -> None:
        """Finds the best noise for the labels of a mode, and flips labels under that noise."""
        if any(mode.is_like(tuned.state) for tuned in self._tuned):
            return
        self._tuned.append(mode)
        best, near = mode, self._near()
        for found in noise.tuned(mode):
            self.keep(found)
            best = min(best, found, key=lambda either: either.cost)
        if best is not mode:
            self.keep(self.flipped(best))
        chosen = best.state.noise
        for other in near:
            if other.labels != mode.labels and other.state.noise.chosen != chosen.chosen:
                state = with_noise(self.problem, other.state, other.state.noise.chosen_as(chosen))
                self.keep(self.flipped(self.polished(state, other.origin)))

    def polished(self, state: State, origin: str) -> Mode:
        """The mode of a state's labels."""
        return Mode(self.problem, *polish(self.problem, state), origin)

    def flipped(self, mode: Mode) -> Mode:
        """The mode with single labels flipped as long as F falls and may come near the least F."""
        return flipped(mode, self._farthest if self.modes else np.inf)

    def keep(self, mode: Mode) -> None:
        """Adds a mode, replacing one with the same labels and a higher F."""
        known = {other.key: other for other in self.modes}
        if mode.key not in known or known[mode.key].cost > mode.cost:
            known[mode.key] = mode
        self.modes = sorted(known.values(), key=lambda other: other.cost)

    @property
    def _farthest(self) -> float:
        """F up to which a mode is a rival of the best."""
        return self.modes[0].cost + self.problem.limits.rival

    def _next(self, done: list[Mode]) -> Mode | None:
        return next((mode for mode in self._near() if not any(mode.is_like(other.state) for other in done)), None)

    def _near(self) -> list[Mode]:
        """The best modes, with only the best of those that are alike."""
        best: list[Mode] = []
        for mode in self.modes:
            if mode.cost > self._farthest or len(best) == _BEAM:
                break
            if not any(mode.is_like(other.state) for other in best):
                best.append(mode)
        return best


def _has_slipped(mode: Mode) -> bool:
    """Whether odometry slipped, or would have slipped with narrower tails."""
    return len(mode.slipped) > 0 or len(hidden_slips(mode)) > 0


def _slips(mode: Mode) -> np.ndarray:
    """Segments that slipped, or would have with narrower tails, along the path; none whose label a user has set."""
    problem, edges = mode.problem, np.union1d(mode.slipped, hidden_slips(mode))
    edges = edges[(edges < problem.graph.num_segments) & np.isfinite(problem.log_odds[edges])]
    return np.asarray(edges[np.argsort(problem.graph.span[0, edges], kind="stable")])


def proposals(mode: Mode) -> Iterator[Proposal]:
    """Proposals of all moves that are switched on."""
    without = mode.problem.without
    if "settling" not in without:
        yield from propose_settling(mode)
        yield from noise.propose_worse_odometry(mode)
    if "doubts" not in without:
        yield from propose_doubts(mode)
    if "rejected-runs" not in without:
        yield from propose_rejected_runs(mode)
    if "joins" not in without:
        yield from propose_joins(mode)
    if "slips" not in without:
        yield from slips.propose_slips(mode)
    if not without & {"slips", "shifts"}:
        yield from slips.propose_shifts(mode)
    if not without & {"slips", "mending"}:
        yield from slips.propose_mending(mode)
    if not without & {"slips", "tails", "wide-tails"}:
        yield from propose_tails(mode)
    if not without & {"slips", "splits"}:
        yield from propose_splits(mode)
