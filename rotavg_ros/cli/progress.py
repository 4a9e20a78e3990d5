"""Shows progress of long steps on a terminal; nothing if stderr is not a terminal."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

# Shorter steps show nothing.
_DELAY_SECONDS = 1.0
_PERIOD_SECONDS = 0.5


def progress(items: Iterable[Item], *, description: str, total: int | None = None, unit: str = "it") -> Iterator[Item]:
    """Pass items through; show a bar whose seconds go on while an item takes long.

    Args:
        total: number of items; None: the length of ``items``, if it has one.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    if not sys.stderr.isatty():
        yield from items
        return
    from tqdm import tqdm  # not imported where no bar can be shown

    with tqdm(desc=description, total=total, unit=unit, leave=False) as bar, _meanwhile(bar.refresh):
        for item in items:
            yield item
            bar.update()


@contextmanager
def seconds_bar(description: str, total: float) -> Iterator[Callable[[float], object]]:
    """A bar over seconds of recorded time with the time left; yields a function that advances it by some seconds."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s [{elapsed}<{remaining}]"
    with tqdm(desc=description, total=total, bar_format=form, leave=False) as bar, _meanwhile(bar.refresh):
        yield bar.update


@contextmanager
def working(description: str) -> Iterator[None]:
    """Show the seconds that pass while one long step runs, from the first one on."""
    if not sys.stderr.isatty():
        yield
        return
    start = time.monotonic()

    def show() -> None:
        print(f"\r{description}: {time.monotonic() - start:.0f} s ", end="", file=sys.stderr, flush=True)

    try:
        with _meanwhile(show):
            yield
    finally:
        if time.monotonic() - start > _DELAY_SECONDS:
            print("\r\033[K", end="", file=sys.stderr, flush=True)  # leave no partial line behind


@contextmanager
def _meanwhile(show: Callable[[], object]) -> Iterator[None]:
    """Call ``show`` again and again from another thread, first after the delay."""
    done = threading.Event()

    def repeat() -> None:
        wait = _DELAY_SECONDS
        while not done.wait(wait):
            show()
            wait = _PERIOD_SECONDS

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
