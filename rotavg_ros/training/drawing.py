"""Drawing runs until enough of them can be learned from."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from rotavg_ros.errors import UserError

# After so many draws in a row that give nothing none is expected to: of one in 50 that gives something, .2 % get here.
_MOST_IN_VAIN = 300

DrawnT = TypeVar("DrawnT")


class DrawingError(UserError):
    """A family of runs of which next to none can be learned from; the message says what they lack."""


def drawn(count: int, draw: Callable[[], DrawnT | None], lack: str) -> list[DrawnT]:
    """``count`` of what is drawn, without the draws that give None.

    Args:
        lack: why a draw gives None, for the error.

    Raises:
        DrawingError: many draws in a row give None.
    """
    found: list[DrawnT] = []
    in_vain = 0
    while len(found) < count:
        one = draw()
        in_vain = in_vain + 1 if one is None else 0
        if one is not None:
            found.append(one)
        elif in_vain == _MOST_IN_VAIN:
            raise DrawingError(f"of {in_vain} simulated runs in a row none can be learned from: {lack}")
    return found
