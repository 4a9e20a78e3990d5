"""Makes a process start and end faster: imported objects live until its end, so they need no garbage collection."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """A context for imports, in a process of one's own.

    Torch makes some hundred thousand objects. The garbage collector would scan them repeatedly while they are created,
    in each full collection later, and at the end: half a second of a short command's CPU time in all
    (docs/performance.md). None of them is ever garbage.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_enabled:
            gc.enable()


def leave_to_the_system() -> None:
    """Call this when the process is about to end, so that the remaining objects are not scanned again."""
    gc.freeze()
