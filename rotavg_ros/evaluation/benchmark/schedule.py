"""Decides which contender runs on which graph: from small to large, within the available time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.benchmark import measure
from rotavg_ros.evaluation.benchmark.measure import ENOUGH_S, LABELS, OURS, Measurement
from rotavg_ros.evaluation.benchmark.plans import FAMILIES, Plan, Series, save
from rotavg_ros.evaluation.common.named_peers import is_available

NO_GPU = "no GPU"
# Solves grow a little faster than the number of edges.
_GROWTH = 1.2
# A process is ended if it takes more than this many times its expected seconds.
_PATIENCE = 8.0
_MIN_TIMEOUT_S = 120.0
# Share of the remaining time that a peer may take: the largest graphs come last and need time, too.
_SHARE_OF_REST = 0.15
# Environment variables that set the number of threads of numerical libraries.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Name under which the time for drawing graphs is learnt, like that of a contender.
_DRAWING = "drawing"


class BenchmarkError(UserError):
    """Nothing that could be measured; the message says why."""


@dataclass(frozen=True)
class Result:
    """The results on one graph: its measurements by contender, and why others have none."""

    plan: Plan
    measured: dict[str, Measurement] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class _Pace:
    """How long a contender takes: seconds of a process before it solves, and of every edge for loading and solving."""

    start_up: float
    loading: float
    solving: float


@dataclass
class _Budget:
    """The time that is left, and the known durations."""

    deadline: float
    repeats: int
    clock: Callable[[], float]
    pace: dict[str, _Pace] = field(default_factory=dict)

    def expected(self, plan: Plan, contender: str) -> float:
        """Seconds of the whole process, 0 where nothing is known."""
        if contender not in self.pace:
            return 0.0
        pace = self.pace[contender]
        solve = pace.solving * float(plan.expected_edges**_GROWTH)
        solves = min(self.repeats, 1 + int(ENOUGH_S / max(solve, 1e-9)))
        return pace.start_up + pace.loading * plan.expected_edges + solves * solve

    def learn(self, plan: Plan, contender: str, seconds: float, solves: Sequence[float]) -> None:
        """From a process that took ``seconds``, ``solves`` of them for solving."""
        besides = max(seconds - sum(solves), 0.0)
        start_up = min(besides, self.pace[contender].start_up if contender in self.pace else besides)
        solving = max(solves, default=0.0) / float(plan.expected_edges**_GROWTH)
        self.pace[contender] = _Pace(start_up, (besides - start_up) / plan.expected_edges, solving)

    def give_up(self, contender: str) -> None:
        """It failed; on larger graphs it would fail again."""
        self.pace[contender] = _Pace(float("inf"), 0.0, 0.0)

    @property
    def left(self) -> float:
        return self.deadline - self.clock()


@dataclass(frozen=True)
class Wishes:
    """What to measure.

    Attributes:
        families: of :data:`FAMILIES`.
        minutes: approximate total time.
        pairs: graphs of fewer or more edges are left out.
        repeats: largest number of solves per process.
        contenders: of :data:`LABELS`; others are left out.
    """

    families: Sequence[str]
    minutes: float
    pairs: tuple[int, int]
    repeats: int
    contenders: Sequence[str] = tuple(LABELS)


def measure_apart(path: Path, contender: str, repeats: int, timeout_s: float) -> Measurement | str:
    """Measure in a process of its own, ended after ``timeout_s``; returns a message instead if it fails."""
    command = [sys.executable, "-m", measure.__name__, str(path), contender, str(repeats)]
    threads = dict.fromkeys(_THREAD_VARIABLES, str(torch.get_num_threads()))
    try:
        finished = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout_s, check=False, env={**os.environ, **threads}
        )
    except subprocess.TimeoutExpired:
        return f"ended after {timeout_s:.0f} s"
    lines = finished.stdout.strip().splitlines()
    if finished.returncode != 0 or not lines:
        words = finished.stderr.strip().splitlines()
        return f"failed with exit code {finished.returncode}: {words[-1][:80] if words else 'no message'}"
    return Measurement(**json.loads(lines[-1]))


@dataclass(frozen=True)
class Stage:
    """How a benchmark measures, reports and reads the time.

    Attributes:
        measure: file of a graph, contender, repeats, seconds at most → its measurement, or why there is none.
        say: told of every measurement.
        clock: seconds.
    """

    measure: Callable[[Path, str, int, float], Measurement | str] = measure_apart
    say: Callable[[str], None] = print
    clock: Callable[[], float] = time.monotonic


def run(wishes: Wishes, stage: Stage | None = None) -> dict[str, list[Result]]:
    """Measure; families get their shares of the time, and what those before them have left.

    Raises:
        BenchmarkError: no graph has such a size, or no contender could be measured on any.
    """
    stage = stage or Stage()
    low, high = wishes.pairs
    sizes = sorted({plan.expected_edges for name in wishes.families for plan in FAMILIES[name].plans})
    if not any(low <= size <= high for size in sizes):
        raise BenchmarkError(
            f"no graph of {', '.join(wishes.families)} has between {low} and {high} edges; "
            f"they have about {', '.join(map(str, sizes))}"
        )
    results = {}
    start, spent = stage.clock(), 0.0
    total = sum(FAMILIES[name].share for name in wishes.families)
    with tempfile.TemporaryDirectory(prefix="rotavg-benchmark-") as folder:
        for name in wishes.families:
            spent += FAMILIES[name].share
            budget = _Budget(start + 60 * wishes.minutes * spent / total, wishes.repeats, stage.clock)
            family = FAMILIES[name]
            plans = tuple(plan for plan in family.plans if low <= plan.expected_edges <= high)
            chosen = tuple(name for name in family.contenders if name in wishes.contenders)
            results[name] = _run_family(replace(family, plans=plans, contenders=chosen), budget, Path(folder), stage)
    of_all = [result for of_family in results.values() for result in of_family]
    if not any(result.measured for result in of_all):
        reasons = {f"{name}: {reason}" for result in of_all for name, reason in result.missing.items()}
        raise BenchmarkError(
            f"nothing was measured ({'; '.join(sorted(reasons)) or 'none of the contenders runs on these graphs'}); "
            "choose other --contenders or --families"
        )
    return results


def _run_family(family: Series, budget: _Budget, folder: Path, stage: Stage) -> list[Result]:
    results = []
    for plan in family.plans:
        result = Result(plan)
        results.append(result)
        for contender in family.contenders:
            if (reason := _why_not(plan, contender, budget)) is not None:
                result.missing[contender] = reason
        runnable = [contender for contender in family.contenders if contender not in result.missing]
        if not runnable:
            continue
        path = folder / f"{plan.key.name}.npz"
        began = stage.clock()
        save(path, plan.draw())
        drawing = stage.clock() - began
        for contender in runnable:
            began = stage.clock()
            timeout_s = max(_MIN_TIMEOUT_S, _PATIENCE * budget.expected(plan, contender))
            outcome = stage.measure(path, contender, budget.repeats, timeout_s)
            if isinstance(outcome, Measurement):
                result.measured[contender] = outcome
                budget.learn(plan, contender, stage.clock() - began, outcome.wall_seconds)
                stage.say(_line(plan, outcome))
            else:
                result.missing[contender] = outcome
                budget.give_up(contender)
        budget.learn(plan, _DRAWING, drawing, [drawing])
        path.unlink()
    return results


def _why_not(plan: Plan, contender: str, budget: _Budget) -> str | None:
    if contender == "neurora-cuda" and not torch.cuda.is_available():
        return NO_GPU
    if not is_available(contender):
        return "not installed"
    expected = budget.expected(plan, contender)
    if expected == float("inf"):
        return "failed on a smaller graph"
    in_all = expected + budget.expected(plan, _DRAWING)
    if in_all > (1.0 if contender in OURS else _SHARE_OF_REST) * budget.left:
        return f"not run: about {expected:.0f} s"
    return None


def _line(plan: Plan, measurement: Measurement) -> str:
    seconds = sorted(measurement.wall_seconds)[len(measurement.wall_seconds) // 2]
    return (
        f"{plan.family}: {measurement.nodes} nodes, {measurement.edges} edges: {LABELS[measurement.contender]} "
        f"{seconds:.3f} s, {measurement.mean_deg:.2f}°"
    )
