"""Solves whose work is counted."""

from __future__ import annotations

import threading

from rotavg_ros.solver.running.work import metered, spend


def test_a_meter_counts_what_meters_inside_it_do() -> None:
    spend(500)  # nobody counts
    with metered() as outer:
        spend(1000)
        with metered() as inner:
            spend(500)
        spend(250)
    assert (outer.spent, inner.spent) == (3.5, 1.0)


def test_solves_on_two_threads_have_a_count_each() -> None:
    counts = {}

    def work(name: str, entries: int) -> None:
        with metered() as meter:
            for _ in range(100):
                spend(entries)
            counts[name] = meter.spent

    threads = [threading.Thread(target=work, args=(str(entries), entries)) for entries in (500, 1500)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counts == {"500": 100.0, "1500": 300.0}
