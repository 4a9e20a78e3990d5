"""Signs of life on a terminal for whatever takes long; nothing where stderr is no terminal."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

# A step that is over sooner shows nothing.
_DELAY_SECONDS = 1.0
_PERIOD_SECONDS = 0.5


def progress(items: Iterable[Item], *, description: str, total: int | None = None, unit: str = "it") -> Iterator[Item]:
    """Pass items through; show a bar whose seconds go on while an item takes long.

    Args:
        total: how many there are; None: as many as ``items`` says, if it does.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    if not sys.stderr.isatty():
        yield from items
        return
    from tqdm import tqdm  # not worth its import where no bar can show

    with tqdm(desc=description, total=total, unit=unit, leave=False) as bar, _meanwhile(bar.refresh):
        for item in items:
            yield item
            bar.update()


@contextmanager
def seconds_bar(description: str, total: float) -> Iterator[Callable[[float], object]]:
    """A bar over seconds of recorded time with the time that is left; yields what moves it on by so many seconds."""
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
            print("\r\033[K", end="", file=sys.stderr, flush=True)  # leave no half line behind


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
