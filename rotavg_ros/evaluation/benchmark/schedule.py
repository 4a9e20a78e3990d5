"""Which contender runs on which graph: from small to large, and no longer than there is time for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from rotavg_ros.evaluation.benchmark.cases import FAMILIES, Case, Family, save
from rotavg_ros.evaluation.benchmark.measure import LABELS, OURS, Measurement
from rotavg_ros.evaluation.contenders import is_available

NO_GPU = "no GPU"
# Costs grow a little faster than the number of edges.
_GROWTH = 1.2
# A process beyond so many times its expected seconds is ended.
_PATIENCE = 8.0
_MIN_TIMEOUT_S = 120.0
# What a contender may take of the time that is left.
_SHARE_OF_REST = 0.35
# Who spreads work over threads reads one of these.
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Graphs of more edges are solved once.
_FEW_REPEATS = 1_000_000
# What drawing the graph takes is learnt like what a contender takes.
_DRAWING = "drawing"


@dataclass(frozen=True)
class Result:
    """What came of one case: its measurements by contender, and why others have none."""

    case: Case
    measured: dict[str, Measurement] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


@dataclass
class _Budget:
    """The time that is left, and what is known of how long things take."""

    deadline: float
    # Seconds of the shortest process so far: what one takes to start.
    start_up: float = float("inf")
    # Seconds beyond that per edge to the power of _GROWTH, by contender.
    rate: dict[str, float] = field(default_factory=dict)

    def expected(self, case: Case, contender: str) -> float:
        """Seconds, 0 where nothing is known."""
        if contender not in self.rate:
            return 0.0
        return self.start_up + self.rate[contender] * float(case.expected_edges**_GROWTH)

    def learn(self, case: Case, contender: str, seconds: float) -> None:
        self.start_up = min(self.start_up, seconds)
        self.rate[contender] = (seconds - self.start_up) / float(case.expected_edges**_GROWTH)

    @property
    def left(self) -> float:
        return self.deadline - time.monotonic()


def run(
    families: Sequence[str], minutes: float, max_pairs: int, repeats: int, say: Callable[[str], None] = print
) -> dict[str, list[Result]]:
    """Measure; families get their shares of the time.

    Args:
        families: of :data:`FAMILIES`.
        minutes: about how long in all.
        max_pairs: larger graphs are left out.
        repeats: solves per process; of large graphs fewer.
        say: told of every measurement.
    """
    results = {}
    start, spent = time.monotonic(), 0.0
    total = sum(FAMILIES[name].share for name in families)
    with tempfile.TemporaryDirectory(prefix="rotavg-benchmark-") as folder:
        for name in families:
            spent += FAMILIES[name].share
            budget = _Budget(start + 60 * minutes * spent / total)
            results[name] = _run_family(FAMILIES[name], budget, max_pairs, repeats, Path(folder), say)
    return results


def _run_family(
    family: Family, budget: _Budget, max_pairs: int, repeats: int, folder: Path, say: Callable[[str], None]
) -> list[Result]:
    results = []
    for case in family.cases:
        if case.expected_edges > max_pairs:
            continue
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
            outcome = _measure(path, contender, repeats if case.expected_edges < _FEW_REPEATS else 1, case, budget)
            if isinstance(outcome, Measurement):
                result.measured[contender] = outcome
                budget.learn(case, contender, time.monotonic() - began)
                say(_line(case, outcome))
            else:
                result.missing[contender] = outcome
                budget.rate[contender] = float("inf")
        budget.learn(case, _DRAWING, drawing + budget.start_up)
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


def _measure(path: Path, contender: str, repeats: int, case: Case, budget: _Budget) -> Measurement | str:
    """Run one process; what went wrong in its place."""
    command = [sys.executable, "-m", "rotavg_ros.evaluation.benchmark.measure", str(path), contender, str(repeats)]
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
