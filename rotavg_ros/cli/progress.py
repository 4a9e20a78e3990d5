"""Signs of life on a terminal for whatever takes longer than two seconds."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

_DELAY_SECONDS = 2.0


def progress(items: Iterable[Item], *, description: str, total: int | None = None, unit: str = "it") -> Iterator[Item]:
    """Pass items through; show a bar on stderr after two seconds, if that is a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    from tqdm import tqdm  # not worth its import where no bar can show

    yield from tqdm(items, desc=description, total=total, unit=unit, delay=_DELAY_SECONDS, leave=False)


@contextmanager
def seconds_bar(description: str, total: float) -> Iterator[Callable[[float], object]]:
    """A bar over seconds of recorded time with the time that is left; yields what moves it on by so many seconds."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} s [{elapsed}<{remaining}]"
    with tqdm(desc=description, total=total, bar_format=form, delay=_DELAY_SECONDS, leave=False) as bar:
        yield bar.update


@contextmanager
def working(description: str) -> Iterator[None]:
    """Show the seconds that pass while one long step runs, after two of them and if stderr is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    done = threading.Event()
    start = time.monotonic()

    def show() -> None:
        wait = _DELAY_SECONDS
        while not done.wait(wait):
            print(f"\r{description}: {time.monotonic() - start:.0f} s ", end="", file=sys.stderr, flush=True)
            wait = 0.5
        if time.monotonic() - start > _DELAY_SECONDS:
            print("\r\033[K", end="", file=sys.stderr, flush=True)  # leave no half line behind

    thread = threading.Thread(target=show, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
