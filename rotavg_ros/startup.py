"""A quicker start and end of a process: what it imports stays until it ends, so no collector need look through it."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def loading() -> Iterator[None]:
    """Import within it, in a process of one's own.

    Torch makes some hundred thousand objects. The garbage collector would go through them again and again while they
    come, with each full collection later on, and at the end: half a second of a short command's CPU time in all
    (docs/performance.md). Nothing of them is ever garbage.
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
    """To be called when the process is about to end: what is left is not looked through once more."""
    gc.freeze()
