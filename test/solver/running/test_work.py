"""Solves whose work is counted."""

from __future__ import annotations

import threading

from rotavg_ros.solver.running.work import metered, spend


def test_a_meter_counts_what_meters_inside_it_do() -> None:
    spend(1)  # nobody counts
    with metered() as outer:
        spend(2)
        with metered() as inner:
            spend(1)
        spend(0.5)
    assert (outer.spent, inner.spent) == (3.5, 1.0)


def test_solves_on_two_threads_have_a_count_each() -> None:
    counts = {}

    def work(name: str, units: int) -> None:
        with metered() as meter:
            for _ in range(100):
                spend(units)
            counts[name] = meter.spent

    threads = [threading.Thread(target=work, args=(str(units), units)) for units in (1, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counts == {"1": 100.0, "3": 300.0}
