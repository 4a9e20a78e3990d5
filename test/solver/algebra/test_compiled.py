"""Functions that numba compiles when they are called, and not before."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rotavg_ros.solver.algebra.compiled import compiled


@compiled
def squared(value: float) -> float:
    """Its square."""
    return value * value


@compiled
def sum_of_squares(values: np.ndarray) -> float:
    total = 0.0
    for value in values:
        total += squared(value)
    return total


def test_one_may_call_another() -> None:
    assert sum_of_squares(np.array([1.0, 2.0, 3.0])) == 14.0
    assert squared(3.0) == 9.0
    assert squared.__doc__ == "Its square."


def test_what_cannot_be_kept_is_compiled_all_the_same() -> None:
    """Without a file there is no folder beside it, as where neither folder can be written to."""
    names: dict[str, Any] = {}
    exec("def twice(value):\n    return 2 * value\n", names)  # noqa: S102
    assert compiled(names["twice"])(3) == 6


@pytest.mark.large
def test_a_photo_collection_is_solved_without_numba() -> None:
    code = (
        "import sys\n"
        "from rotavg_ros import ViewGraph, solve\n"
        "solve(ViewGraph.create([0, 1, 2], [1, 2, 0], [[0, 0, 0, 1]] * 3))\n"
        "assert 'rotavg_ros.solver.slam.solve' in sys.modules\n"
        "assert 'numba' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize(
    ("suffix", "left"),
    [
        ("nbi", b""),
        *(
            pytest.param(*case, marks=pytest.mark.large)
            for case in (("nbi", bytes(200)), ("nbc", b""), ("nbc", bytes(200)))
        ),
    ],
)
def test_what_a_power_cut_left_of_machine_code_is_made_again(suffix: str, left: bytes, tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(
        "from rotavg_ros.solver.algebra.compiled import compiled\n"
        "@compiled\n"
        "def inner(value):\n    return value + 1\n"
        "@compiled\n"
        "def outer(value):\n    return 2 * inner(value)\n"
    )
    code = "from module import outer; print(outer(2)); print(sum(outer.dispatcher.stats.cache_hits.values()))"
    path = os.pathsep.join((str(tmp_path), *filter(None, sys.path)))
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONPATH": path}

    def answers() -> list[str]:
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.split()

    assert answers() == ["6", "0"]
    kept = list((tmp_path / "cache").rglob(f"*.{suffix}"))
    assert len(kept) == 1  # the outer one's code contains the inner one
    for each in kept:
        each.write_bytes(left)
    assert answers() == ["6", "0"]
    assert answers() == ["6", "1"]
