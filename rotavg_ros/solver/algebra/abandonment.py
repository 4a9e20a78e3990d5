"""Giving up a solve that nobody waits for any more: whoever started it says when, and its inner loops ask.

The question belongs to the context of a solve, so solves that overlap in threads have one each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Abandoned(Exception):  # noqa: N818 - it is no error: whoever catches it has asked for it
    """The solve was given up. It has changed nothing that outlives it."""


def _never() -> bool:
    return False


_is_abandoned: ContextVar[Callable[[], bool]] = ContextVar("is_abandoned", default=_never)


@contextmanager
def abandonable(is_abandoned: Callable[[], bool]) -> Iterator[None]:
    """Inside, a solve of this thread raises :class:`Abandoned` soon after ``is_abandoned`` says so.

    Args:
        is_abandoned: asked some thousand times a second, on several threads at once.
    """
    token = _is_abandoned.set(is_abandoned)
    try:
        yield
    finally:
        _is_abandoned.reset(token)


def stop_if_abandoned() -> None:
    """Call it once per factorisation, iteration, search step or tile; it costs a tenth of a microsecond.

    Raises:
        Abandoned: the solve around this was given up.
    """
    if _is_abandoned.get()():
        raise Abandoned
