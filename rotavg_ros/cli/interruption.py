"""Ctrl-C, SIGTERM and SIGHUP: the end at once while a command loads, later an exception, so that it tidies up."""

from __future__ import annotations

import os
import signal
from types import FrameType

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """Whether somebody wants the end.

    Args:
        is_own_process: take the signals over; those that are ignored, as ``nohup`` has it, stay so.
    """

    def __init__(self, is_own_process: bool) -> None:
        self._is_loading = True
        self._number: int | None = None
        for number in _NUMBERS if is_own_process else ():
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    @property
    def exit_code(self) -> int:
        """As shells have it, 128 and the signal's number; 0: nobody has asked."""
        return 0 if self._number is None else 128 + self._number

    def has_loaded(self) -> None:
        """From now on there may be something to tidy up."""
        self._is_loading = False

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if self._is_loading:
            os.write(2, b"rotavg: interrupted\n")
            os._exit(128 + number)  # an exception would come out of some import as that module's fault
        self._number = number
        raise KeyboardInterrupt
