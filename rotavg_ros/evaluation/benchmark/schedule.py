"""Which contender runs on which graph: from small to large, and no longer than there is time for."""

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
from rotavg_ros.evaluation.benchmark.cases import FAMILIES, Case, Family, save
from rotavg_ros.evaluation.benchmark.measure import ENOUGH_S, LABELS, OURS, Measurement
from rotavg_ros.evaluation.named_peers import is_available

NO_GPU = "no GPU"
# Solves grow a little faster than the number of edges.
_GROWTH = 1.2
# A process beyond so many times its expected seconds is ended.
_PATIENCE = 8.0
_MIN_TIMEOUT_S = 120.0
# What a peer may take of the time that is left: the largest graphs come last, and some must be left for them.
_SHARE_OF_REST = 0.15
# Who spreads work over threads reads one of these.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# What drawing the graph takes is learnt like what a contender takes.
_DRAWING = "drawing"


class BenchmarkError(UserError):
    """Nothing that could be measured; the message says why."""


@dataclass(frozen=True)
class Result:
    """What came of one case: its measurements by contender, and why others have none."""

    case: Case
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
    """The time that is left, and what is known of how long things take."""

    deadline: float
    repeats: int
    pace: dict[str, _Pace] = field(default_factory=dict)

    def expected(self, case: Case, contender: str) -> float:
        """Seconds of the whole process, 0 where nothing is known."""
        if contender not in self.pace:
            return 0.0
        pace = self.pace[contender]
        solve = pace.solving * float(case.expected_edges**_GROWTH)
        solves = min(self.repeats, 1 + int(ENOUGH_S / max(solve, 1e-9)))
        return pace.start_up + pace.loading * case.expected_edges + solves * solve

    def learn(self, case: Case, contender: str, seconds: float, solves: Sequence[float]) -> None:
        """From a process that took ``seconds``, ``solves`` of them for solving."""
        besides = max(seconds - sum(solves), 0.0)
        start_up = min(besides, self.pace[contender].start_up if contender in self.pace else besides)
        solving = max(solves, default=0.0) / float(case.expected_edges**_GROWTH)
        self.pace[contender] = _Pace(start_up, (besides - start_up) / case.expected_edges, solving)

    def give_up(self, contender: str) -> None:
        """It failed; on larger graphs it would fail again."""
        self.pace[contender] = _Pace(float("inf"), 0.0, 0.0)

    @property
    def left(self) -> float:
        return self.deadline - time.monotonic()


def run(
    families: Sequence[str],
    minutes: float,
    pairs: tuple[int, int],
    repeats: int,
    contenders: Sequence[str] = tuple(LABELS),
    say: Callable[[str], None] = print,
) -> dict[str, list[Result]]:
    """Measure; families get their shares of the time, and what those before them have left.

    Args:
        families: of :data:`FAMILIES`.
        minutes: about how long in all.
        pairs: graphs of fewer or more edges are left out.
        repeats: solves per process at most.
        contenders: of :data:`LABELS`; others are left out.
        say: told of every measurement.

    Raises:
        BenchmarkError: no graph is of such a size, or no contender could be measured on any.
    """
    sizes = sorted({case.expected_edges for name in families for case in FAMILIES[name].cases})
    if not any(pairs[0] <= size <= pairs[1] for size in sizes):
        raise BenchmarkError(
            f"no graph of {', '.join(families)} has between {pairs[0]} and {pairs[1]} edges; "
            f"they have about {', '.join(map(str, sizes))}"
        )
    results = {}
    start, spent = time.monotonic(), 0.0
    total = sum(FAMILIES[name].share for name in families)
    with tempfile.TemporaryDirectory(prefix="rotavg-benchmark-") as folder:
        for name in families:
            spent += FAMILIES[name].share
            budget = _Budget(start + 60 * minutes * spent / total, repeats)
            family = FAMILIES[name]
            cases = tuple(case for case in family.cases if pairs[0] <= case.expected_edges <= pairs[1])
            chosen = tuple(name for name in family.contenders if name in contenders)
            results[name] = _run_family(replace(family, cases=cases, contenders=chosen), budget, Path(folder), say)
    of_all = [result for of_family in results.values() for result in of_family]
    if not any(result.measured for result in of_all):
        reasons = {f"{name}: {reason}" for result in of_all for name, reason in result.missing.items()}
        raise BenchmarkError(
            f"nothing was measured ({'; '.join(sorted(reasons)) or 'none of the contenders runs on these graphs'}); "
            "choose other --contenders or --families"
        )
    return results


def _run_family(family: Family, budget: _Budget, folder: Path, say: Callable[[str], None]) -> list[Result]:
    results = []
    for case in family.cases:
        result = Result(case)
        results.append(result)
        for contender in family.contenders:
            if (reason := _why_not(case, contender, budget)) is not None:
                result.missing[contender] = reason
        runnable = [contender for contender in family.contenders if contender not in result.missing]
        if not runnable:
            continue
        path = folder / f"{case.name}.npz"
        began = time.monotonic()
        save(path, case.draw())
        drawing = time.monotonic() - began
        for contender in runnable:
            began = time.monotonic()
            outcome = _measure(path, contender, case, budget)
            if isinstance(outcome, Measurement):
                result.measured[contender] = outcome
                budget.learn(case, contender, time.monotonic() - began, outcome.wall_seconds)
                say(_line(case, outcome))
            else:
                result.missing[contender] = outcome
                budget.give_up(contender)
        budget.learn(case, _DRAWING, drawing, [drawing])
        path.unlink()
    return results


def _why_not(case: Case, contender: str, budget: _Budget) -> str | None:
    if contender == "neurora-cuda" and not torch.cuda.is_available():
        return NO_GPU
    if not is_available(contender):
        return "not installed"
    expected = budget.expected(case, contender)
    if expected == float("inf"):
        return "failed on a smaller graph"
    in_all = expected + budget.expected(case, _DRAWING)
    if in_all > (1.0 if contender in OURS else _SHARE_OF_REST) * budget.left:
        return f"not run: about {expected:.0f} s"
    return None


def _measure(path: Path, contender: str, case: Case, budget: _Budget) -> Measurement | str:
    """Run one process; what went wrong in its place."""
    command = [sys.executable, "-m", "rotavg_ros.evaluation.benchmark.measure", str(path), contender]
    command.append(str(budget.repeats))
    timeout = max(_MIN_TIMEOUT_S, _PATIENCE * budget.expected(case, contender))
    threads = dict.fromkeys(_THREAD_VARIABLES, str(torch.get_num_threads()))
    try:
        finished = subprocess.run(
            command, capture_output=True, text=True, timeout=timeout, check=False, env={**os.environ, **threads}
        )
    except subprocess.TimeoutExpired:
        return f"ended after {timeout:.0f} s"
    lines = finished.stdout.strip().splitlines()
    if finished.returncode != 0 or not lines:
        words = finished.stderr.strip().splitlines()
        return f"failed with exit code {finished.returncode}: {words[-1][:80] if words else 'no message'}"
    return Measurement(**json.loads(lines[-1]))


def _line(case: Case, measurement: Measurement) -> str:
    seconds = sorted(measurement.wall_seconds)[len(measurement.wall_seconds) // 2]
    return (
        f"{case.family}: {measurement.nodes} nodes, {measurement.edges} edges: {LABELS[measurement.contender]} "
        f"{seconds:.3f} s, {measurement.mean_deg:.2f}°"
    )
