"""A solve while it runs: given up where nobody waits for it, left for a while between two steps, its work counted.

Both the question whether it is given up and the count belong to the context of a solve, so solves that overlap in
threads have one each.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TypeVar

Result = TypeVar("Result")
# What may be left after each of its steps and gone on with later; its result comes at the end.
Steps = Generator[None, None, Result]

# Entries of a sparse matrix to one unit, which is about a millisecond with all that is done around a factorisation.
_ENTRIES = 500.0


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


@dataclass
class Meter:
    """Counts units.

    Attributes:
        spent: so far.
    """

    spent: float = 0.0


_meter: ContextVar[Meter | None] = ContextVar("meter", default=None)


@contextmanager
def metered() -> Iterator[Meter]:
    """Inside, what a solve of this thread spends is counted, by meters around this one as well."""
    meter, around = Meter(), _meter.get()
    token = _meter.set(meter)
    try:
        yield meter
    finally:
        _meter.reset(token)
        if around is not None:
            around.spent += meter.spent


def spend(entries: int) -> None:
    """Call it once per factorisation of a matrix of so many entries."""
    meter = _meter.get()
    if meter is not None:
        meter.spent += entries / _ENTRIES


def done(steps: Steps[Result]) -> Result:
    """The result of all steps, one after the other."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: Result = end.value
            return result
