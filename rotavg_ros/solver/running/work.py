"""Control of a running solve: abandon it when nobody waits for it, count its work, suspend it.

All state belongs to the context of a solve, so solves that overlap in threads have one each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

# Seconds of CPU that a unit of work takes: .39 to .54 ms in every part of robots' solves where it was measured
# (docs/diary/ticks.md, "Units of work"). Work is counted in units, which are the same on every machine; seconds are for
# people, and for a node until its first ticks have shown how fast its machine is.
SECONDS_PER_UNIT = 5e-4
# Entries on one side of a sparse matrix per unit of work, including everything done around a factorisation.
ENTRIES = 500.0


class Abandoned(Exception):  # noqa: N818 - it is no error: whoever catches it has asked for it
    """The solve was given up. It has changed nothing that outlives it."""


def _never() -> bool:
    return False


_is_abandoned: ContextVar[Callable[[], bool]] = ContextVar("is_abandoned", default=_never)


@contextmanager
def abandonable(is_abandoned: Callable[[], bool]) -> Iterator[None]:
    """Inside, a solve of this thread raises :class:`Abandoned` soon after ``is_abandoned`` says so.

    Args:
        is_abandoned: called some thousand times a second, on several threads at once.
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
    """Counts work.

    Attributes:
        spent: units so far, :data:`SECONDS_PER_UNIT` each.
    """

    spent: float = 0.0


_meter: ContextVar[Meter | None] = ContextVar("meter", default=None)


@contextmanager
def metered() -> Iterator[Meter]:
    """Inside, the work of this thread's solve is counted, also by enclosing meters."""
    meter, around = Meter(), _meter.get()
    token = _meter.set(meter)
    try:
        yield meter
    finally:
        _meter.reset(token)
        if around is not None:
            around.spent += meter.spent


_rests: ContextVar[Callable[[float], None] | None] = ContextVar("rests", default=None)


@contextmanager
def resting(rest: Callable[[float], None]) -> Iterator[None]:
    """Inside, ``rest`` is called before each factorisation with its units, and may wait."""
    token = _rests.set(rest)
    try:
        yield
    finally:
        _rests.reset(token)


def spend(units: float) -> None:
    """Call it once before a factorisation, or a part of one, that costs ``units``."""
    count(units)
    rest = _rests.get()
    if rest is not None:
        rest(units)


def rest() -> None:
    """Call it where much work lies between two factorisations."""
    waits = _rests.get()
    if waits is not None:
        waits(0.0)


def count(units: float) -> None:
    """Add units of work that were spent elsewhere for this solve."""
    meter = _meter.get()
    if meter is not None:
        meter.spent += units


def abandonment() -> Callable[[], bool]:
    """The function that tells whether the enclosing solve is abandoned."""
    return _is_abandoned.get()
