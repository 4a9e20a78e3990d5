"""Odometry whose position jumps although its heading does not: spinning wheels, a tracker that relocalises elsewhere.

Such a step is wrong by about the length that it reports, and a segment by its longest step. Closures across the jump
then seem to join wrong places, all by the same shift of the world. If one jump, or a jump and a second one that undoes
it, explains enough of them to outweigh its cost, poses are estimated again with it, and −log p decides, as between any
two labellings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.search.discrepancies import log_normal
from rotavg_ros.solver.slam.poses.search.jump_witnesses import AS_FAR, Jump, Place, Proposal, Witnesses
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.em import polish_fully
from rotavg_ros.solver.slam.posterior.labels.prior import log_slip_prior
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.wording import between_nodes

# Maximum number of shifts that are examined, those proposed by the closures of largest gain first; and number of these
# for which displaced stretches are examined as well.
_LOOKED_AT, _STRETCHES = 48, 4


def log_jump_prior(problem: PoseProblem) -> float:
    """Log prior, nats, of the set of jumps: as rare as slips, each in the longest step of its segment."""
    jumped = np.flatnonzero(problem.jumps)
    any_step = np.log(np.maximum(problem.drawn.own_steps[jumped], 1.0))
    return log_slip_prior(problem.mode.problem, jumped) - float(any_step.sum())


def likeliest_jump(pose: PoseMode, least: float) -> Jump | None:
    """The jump of largest predicted gain, by closures that do not fit or by all that does.

    None if there is none that gains at least ``least`` nats.
    """
    price = _price(pose.problem)
    told = [jump for jump in (_by_witnesses(pose, price, least), _by_all_else(pose, price)) if jump is not None]
    return max((jump for jump in told if jump.gained >= least), key=lambda jump: jump.gained, default=None)


def _by_witnesses(pose: PoseMode, price: float, least: float) -> Jump | None:
    """The likeliest jump by closures; None if none makes at least two right, or an accepted one, and gains that."""
    witnesses = Witnesses.of(pose, price)
    proposers: list[int] = []
    left = witnesses.is_wrong.copy()
    while witnesses.are_enough(left) and len(proposers) < _LOOKED_AT:
        # The closure of largest gain proposes the next shift; those that agree with it need not propose theirs.
        proposers.append(int(np.argmax(np.where(left, witnesses.gain, -1.0))))
        left &= ~witnesses.agreeing(proposers[-1])
    proposals = [proposal for each in proposers for proposal in witnesses.proposals(each)]
    best = _best(witnesses, _jumps(witnesses, proposals, witnesses.place, least))
    if best is not None and best.gained > 0:
        return best
    several = _jumps(witnesses, proposals[:_STRETCHES], witnesses.stretch, least)
    return _best(witnesses, [jump for jump in (best, *several) if jump is not None])


def _jumps(
    witnesses: Witnesses, proposals: list[Proposal], placed: Callable[[Proposal], Place], least: float
) -> list[Jump]:
    """The jumps by some shifts, without those that gain less than ``least`` even where every gain is the largest.

    What closures say of each other is a dense solve for each shift.
    """
    could = [each for each in proposals if witnesses.jump(each, placed(each)).gained >= least]
    gain = {end: witnesses.gain_given(end) for end in dict.fromkeys(each.end for each in could)}
    told = [each._replace(gain=gain[each.end]) for each in could]
    return [witnesses.jump(each, placed(each)) for each in told]


def _best(witnesses: Witnesses, jumps: list[Jump]) -> Jump | None:
    told = [jump for jump in jumps if witnesses.are_enough(jump.freed[witnesses.closure])]
    return max(told, key=lambda jump: jump.gained, default=None)


def _by_all_else(pose: PoseMode, price: float) -> Jump | None:
    """The segment that is likeliest to have jumped by what all other rows predict of it; None if none gains by that.

    Odometry beside the chain holds places together across a jump: then all closures fit, and nothing is to be moved.

    Args:
        pose: poses.
        price: nats, minus the log prior of one more jump.
    """
    problem, solved = pose.problem, pose.solved
    could = np.flatnonzero((problem.jumps == 0) & (problem.could_jump > 0) & ~problem.slipped)
    if len(could) == 0:
        return None
    others, covariance = solved.factor.without(could)
    off = np.matmul(others, solved.left[could])[:, :, 0]
    total = covariance + np.eye(off.shape[1])
    # A jump's variance, in the units of the whitened row.
    free = np.zeros((len(could), off.shape[1], problem.shifts))
    free[:, problem.turns :] = inverse_root(solved.covariance[could][:, ::-1, ::-1])[:, ::-1, ::-1]
    jumped = total + problem.could_jump[could, None, None] * free @ free.transpose(0, 2, 1)
    gained = log_normal(off, jumped) - log_normal(off, total) - price
    best = int(np.argmax(gained))
    if gained[best] < 0:  # no labels change, so there is nothing that the prediction leaves out
        return None
    nowhere, none = np.zeros(problem.drawn.num_nodes, dtype=bool), np.zeros(len(problem.closures), dtype=bool)
    return Jump(int(could[best]), -1, nowhere, np.zeros(3), float(gained[best]), none)


def _price(problem: PoseProblem) -> float:
    """Nats, minus the log prior of one more jump: the same in every segment, so segment 0 stands for it."""
    another = np.append(np.flatnonzero(problem.jumps), 0)
    any_step = float(np.log(np.maximum(problem.drawn.own_steps[another], 1.0)).sum())
    return log_jump_prior(problem) - log_slip_prior(problem.mode.problem, another) + any_step


def with_jump(pose: PoseMode, jump: Jump) -> tuple[PoseProblem, PoseStart]:
    """The problem with one more jump, and a start with what is behind it displaced and the freed closures believed."""
    problem, state = pose.problem, pose.state
    ends = [segment for segment in (jump.segment, jump.back) if segment >= 0]
    variance = np.zeros(problem.graph.num_edges) if problem.jump is None else problem.jump.copy()
    variance[problem.longest_steps[ends]] = problem.could_jump[ends]
    state = replace(state, position=state.position + jump.moved[:, None] * jump.shift)
    freed = np.flatnonzero(jump.freed)
    start = replace(PoseStart.believing(pose, freed), state=state)
    return replace(problem, mode=_trusting(pose, freed), jump=variance), start


def _trusting(pose: PoseMode, closures: np.ndarray) -> Mode:
    """The labelling of rotations in which some closures ``(n,)`` are good.

    Some may be labelled false however well they fit, since false rotations that agree support each other.
    """
    before = pose.problem.mode
    edges = before.problem.closure[closures]
    if before.state.is_good[edges].all():
        return before
    trusted = before.state.trusted.copy()
    trusted[edges] = 1.0
    state = replace(before.state, correction=pose.state.correction, trusted=trusted)
    return Mode(before.problem, *polish_fully(before.problem, state), before.origin)


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
    """``(n,)`` bool: whether segments jump by more than ``AS_FAR`` times the length of their longest step."""
    square = (_jumped_by(pose, segments) ** 2).sum(axis=1)
    return np.asarray(square > AS_FAR**2 * pose.problem.could_jump[segments])


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
        f"({between_nodes(first, last)}): closures on both sides agree on that. Wheels may have spun, or a tracker "
        "may have been lost.",
    )
