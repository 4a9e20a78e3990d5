"""The published answer of rival labellings: averaged scores and median orientations; closures are probabilities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.exceedance import OUTLIER_ANGLE, exceedance
from rotavg_ros.solver.slam.posterior.em import step
from rotavg_ros.solver.slam.posterior.left_out import leave_one_out, scores
from rotavg_ros.solver.slam.posterior.mode import OTHER_NOISE, Mode
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.publishing.gravity import held_by_gravity
from rotavg_ros.solver.slam.posterior.state import Noise

# Labellings less likely than the best by more than this, nats, are ignored, and so is other noise of the same labels.
_FAR, _FAR_NOISE = 5.0, 2.0
# A warning is given for rivals of at least this probability that turn a node by more than this, rad.
LIKELY, FAR_TURN = 0.05, np.radians(5.0)
# A closure with a lower probability of being good has no weight at all.
_SURELY_FALSE = 0.05
_ROUNDS = 2
# Units of work per scored edge.
_SCORED = 0.0015


@dataclass(frozen=True)
class Published:
    """The published answer on a closure graph (K key nodes, E edges).

    Attributes:
        graph: the closure graph, with nodes placed along segments by the likeliest noise.
        correction: ``(4, K)``.
        outlier_probability: ``(E,)``.
        of_restated: ``(n,)`` the same of closures that are made of odometry.
        variance: ``(N,)`` rad², of the view-graph's nodes, relative to the first of their component.
        noise: noise of the likeliest labelling.
        chosen: index of the mode whose orientations are published, the median.
        rivals: probabilities of the averaged labellings, the best first; those under other noise after all others.
        warnings: given where rivals are likely and differ.
    """

    graph: ClosureGraph
    correction: np.ndarray
    outlier_probability: np.ndarray
    of_restated: np.ndarray
    variance: np.ndarray
    noise: Noise
    chosen: int
    rivals: tuple[float, ...]
    warnings: tuple[str, ...] = ()

    @property
    def body_from_world(self) -> Tensor:
        """``(N, 4)`` orientations of the view-graph's nodes."""
        return self.graph.orientations(torch.from_numpy(np.ascontiguousarray(self.correction.T)))


def publish(problem: Problem, modes: list[Mode], tuned: Callable[[Mode], Mode] = lambda mode: mode) -> Published:
    """The average score of distinct modes, weighted by exp(−F), and the orientations of their median.

    Args:
        problem: the graph.
        modes: the best first.
        tuned: function that sets each edge's noise in a mode by FineNet; the probabilities of labellings do not change.
    """
    rivals, share = (modes[:1], np.ones(1)) if "rivals" in problem.without else distinct(problem, modes)
    answers = [of_mode(tuned(mode)) for mode in rivals]
    seen = [answer.graph.from_first(answer.correction) for answer in answers]
    middle = median(seen, share)
    chosen, base = answers[middle], quaternion_rows.inverse(seen[middle])
    turns = [quaternion_rows.log(quaternion_rows.multiply(base, each)) for each in seen]
    score, of_restated = (
        sum(weight * getattr(answer, name) for weight, answer in zip(share, answers, strict=True))
        for name in ("outlier_probability", "of_restated")
    )
    graph, k = chosen.graph, problem.components
    variance = np.zeros(len(chosen.variance))
    for weight, answer, turn in zip(share, answers, turns, strict=True):
        off = np.sqrt((turn**2).sum(axis=0) / k)
        spread = graph.interpolated(off)
        spread[graph.first] = 0.0  # by definition, where rivals turn the ends of its segment otherwise
        variance += weight * (answer.variance + spread**2)
    warnings = warnings_of(problem, rivals, share, turns, middle)
    number = next(number for number, mode in enumerate(modes) if mode is rivals[middle])
    # Shares add up to one up to rounding.
    score, of_restated = (np.clip(each, 0.0, 1.0) for each in (score, of_restated))
    told = score, of_restated, variance, answers[0].noise
    return Published(graph, chosen.correction, *told, number, tuple(share.tolist()), warnings)


def median(corrections: list[np.ndarray], share: np.ndarray) -> int:
    """Index of the orientations, of several ``(4, K)``, with the least mean angle to all, weighted by their shares.

    A mean would not do: between two maps that are folded differently, it is near neither.
    """
    if len(corrections) == 1:
        return 0
    cosine = np.array([[np.abs((one * other).sum(axis=0)) for other in corrections] for one in corrections])
    angle = 2 * np.arccos(np.minimum(cosine, 1.0)).mean(axis=2)
    return int(np.argmin(angle @ share))


def warnings_of(
    problem: Problem, rivals: list[Mode], share: np.ndarray, turns: list[np.ndarray], chosen: int
) -> tuple[str, ...]:
    """Warnings about the differences of rivals from the chosen one, if a likely one turns a part of the map by far.

    Args:
        problem: the graph.
        rivals: labellings.
        share: ``(n,)`` their probabilities.
        turns: of each, ``(3, K)`` rad from the chosen one's orientations.
        chosen: the index of that.
    """
    largest = [float(np.sqrt((turn**2).sum(axis=0)).max(initial=0.0)) for turn in turns]
    others = [
        number
        for number in range(len(rivals))
        if share[number] >= LIKELY and largest[number] > FAR_TURN and not rivals[number].is_like(rivals[chosen].state)
    ]
    if not others:
        return ()
    differs = np.any([rivals[number].state.is_good != rivals[chosen].state.is_good for number in others], axis=0)
    closures, steps = int(differs[problem.closure].sum()), int(differs[problem.graph.is_odometry].sum())
    turned = np.degrees(max(largest[number] for number in others))
    change = f"turn parts of the map by up to {turned:.0f}°"
    return (warning_of_rivals(float(share[others].sum()), closures, steps, change),)


def warning_of_rivals(share: float, closures: int, steps: int, change: str) -> str:
    """The warning that answers of this probability in all judge some edges differently, and what that changes."""
    return (
        f"Other answers are nearly as likely ({100 * share:.0f} %): they judge {closures} closures and {steps} "
        f"stretches of odometry differently, and {change}. The published orientations are the median of all: look at "
        "their uncertainty, and label the closures that you know."
    )


def distinct(problem: Problem, modes: list[Mode]) -> tuple[list[Mode], np.ndarray]:
    """Modes that are not alike a better one, and their probabilities; the best first.

    Labellings are distinct if they differ in a slip, in two closures of a run or in orientations; within each, single
    closures are probabilities. A labelling's probability is that under its best noise, so it does not grow with the
    number of noises tried.
    """
    labellings: list[list[Mode]] = []
    for mode in modes:
        if mode.cost > modes[0].cost + _FAR:
            break
        alike = next((others for others in labellings if mode.is_like(others[0].state)), None)
        if alike is None:
            labellings.append([mode])
        elif mode.cost <= alike[0].cost + _FAR_NOISE and all(_has_other_noise(mode, other) for other in alike):
            alike.append(mode)
    least = np.array([others[0].cost for others in labellings[: problem.limits.averaged]])
    share = np.exp(least[0] - least)
    share /= share.sum()
    first = [(others[0], number) for number, others in enumerate(labellings)]
    more = [(mode, number) for number, others in enumerate(labellings) for mode in others[1:]]
    kept = (first + sorted(more, key=lambda other: other[0].cost))[: problem.limits.averaged]
    within = np.exp([least[number] - mode.cost for mode, number in kept])
    number = np.array([number for _, number in kept])
    shares = share[number] * within / np.bincount(number, within)[number]
    return [mode for mode, _ in kept], shares


def _has_other_noise(mode: Mode, other: Mode) -> bool:
    noise, other_noise = mode.state.noise, other.state.noise
    return abs(noise.log_ratio - other_noise.log_ratio) > OTHER_NOISE or noise.chosen != other_noise.chosen


def of_mode(mode: Mode) -> Published:
    """One labelling's answer, with single closures weighted by their leave-one-out probabilities.

    Slips stay as labelled: evidence about a slip comes from many closures jointly, so it distinguishes labellings.
    """
    problem, state, left_out = mode.problem, mode.state, mode.left_out
    is_decided, decided = np.isinf(problem.log_odds) | problem.graph.is_odometry, state.is_good
    for number in range(_ROUNDS):
        spend(_SCORED * len(state.trusted))
        score, trust = scores(problem, state, left_out)
        if number > 0:  # otherwise closures that depend on each other could alternate from round to round
            trust = (trust + state.trusted) / 2
        trusted = np.where(trust < _SURELY_FALSE, 0.0, trust)
        trusted = np.where(is_decided, decided, trusted).astype(np.float64)
        state, _, _, factorised = step(problem, replace(state, trusted=trusted))
        if number < _ROUNDS - 1:
            left_out = leave_one_out(problem, state, factorised)
    spend(_SCORED * len(state.trusted))
    graph, held = problem.drawn(state.noise), held_by_gravity(problem, state, factorised)
    variance = graph.variance(held.variance, held.apart, held.step_variance, held.with_first)
    answer = Published(graph, held.state.correction, score, np.zeros(0), variance, state.noise, 0, (1.0,))
    if len(graph.restated.edge) == 0:
        return answer
    off = graph.off_odometry(answer.body_from_world.numpy())
    of_restated = exceedance(off, graph.restated.steps * held.step_variance, OUTLIER_ANGLE, problem.components)
    return replace(answer, of_restated=of_restated)
