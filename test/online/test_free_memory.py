"""Memory that a solve took goes back to the system."""

from __future__ import annotations

import gc
import platform
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.online import free_memory
from rotavg_ros.online.estimator import OnlineEstimator
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference
from rotavg_ros.solver.algebra.sparse import sparse_factor

MEGABYTE = 1_000_000


def resident_bytes() -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS"):
            return 1024 * int(line.split()[1])
    pytest.skip("the kernel does not say how much memory the process has")


def test_free_memory_below_what_is_kept_goes_back() -> None:
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("another C library cannot give memory back")
    pieces = [bytearray(10_000) for _ in range(10_000)]
    kept = pieces[-1]
    full = resident_bytes()
    pieces.clear()
    free_memory.give_back()
    assert full - resident_bytes() > 80 * MEGABYTE
    assert len(kept) == 10_000


@pytest.mark.parametrize(("many", "times"), [(3, 1), (4, 0)])
def test_ticks_of_large_graphs_give_memory_back(monkeypatch: pytest.MonkeyPatch, many: int, times: int) -> None:
    calls: list[None] = []
    monkeypatch.setattr(free_memory, "_MANY_EDGES", many)
    monkeypatch.setattr(free_memory, "give_back", lambda: calls.append(None))
    online = OnlineEstimator()
    for index in range(3):
        online.add_odometry("robot", index * 10**9, (0.0, 0.0, 0.0, 1.0), (index, 0.0, 0.0))
    ends = KeyframeReference("robot", 0), KeyframeReference("robot", 2)
    online.add_edge(EdgeMeasurement(0, *ends, (0.0, 0.0, 0.0, 1.0)))
    answer = online.tick()
    assert answer is not None and len(answer.source) == 3
    assert answer.seconds > 0
    assert len(calls) == times
    # What goes on from the answer before takes little.
    online.add_odometry("robot", 3 * 10**9, (0.0, 0.0, 0.0, 1.0), (3, 0.0, 0.0))
    assert online.tick() is not None and len(calls) == times


def test_work_after_answers_gives_memory_back_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[None] = []
    monkeypatch.setattr(free_memory, "_MUCH_WORK", 10.0)
    monkeypatch.setattr(free_memory, "give_back", lambda: calls.append(None))
    online = OnlineEstimator(solver=lambda *_, **__: None, advance=lambda _, work: work)
    for _ in range(5):
        online.go_on(4.0)
    assert len(calls) == 1
    online.go_on(4.0)
    assert len(calls) == 2


def _ticks(online: OnlineEstimator, first: int, last: int, *, has_places: bool) -> Iterator[None]:
    """A robot that drives straight on and sees that it does, a tick every five keyframes."""
    rng = np.random.default_rng(first)
    for index in range(first, last):
        online.add_odometry("robot", index * 10**9, (0.0, 0.0, 0.0, 1.0), (index, 0.0, 0.0))
        if index >= 40:
            before = index - 20 - int(rng.integers(20))
            ends = KeyframeReference("robot", before), KeyframeReference("robot", index)
            turn = np.radians(rng.normal(0.0, 1.0)) / 2
            edge = EdgeMeasurement(index, *ends, (0.0, 0.0, np.sin(turn), np.cos(turn)))
            way = (index - before + rng.normal(0.0, 0.1), rng.normal(0.0, 0.1), 0.0)
            online.add_edge(replace(edge, translation=way) if has_places else edge)
        if index % 5 == 4:
            online.tick()
            online.go_on()
            yield


@pytest.mark.parametrize("has_places", [False, pytest.param(True, marks=pytest.mark.large)])
def test_ticks_leave_nothing_behind(has_places: bool) -> None:
    """What stays is what the next one goes on from, and a search under way; no garbage waits to be collected."""
    online = OnlineEstimator()
    alive = []
    for _ in _ticks(online, 0, 80, has_places=has_places):
        alive.append(len(sparse_factor._live))
    gc.collect()
    gc.disable()
    gc.set_debug(gc.DEBUG_SAVEALL)
    try:
        for _ in _ticks(online, 80, 160, has_places=has_places):
            alive.append(len(sparse_factor._live))
        gc.collect()
        garbage = [type(each).__name__ for each in gc.garbage if type(each).__module__.startswith("rotavg_ros")]
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        gc.enable()
    assert garbage == []
    assert online.counts().edges > 250
    assert max(alive[-10:]) < 40
