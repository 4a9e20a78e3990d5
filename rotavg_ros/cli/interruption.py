"""Ctrl-C, SIGTERM and SIGHUP: they end a loading command at once; later they raise, so that it can clean up."""

from __future__ import annotations

import os
import signal
from types import FrameType

_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption:
    """Whether the end has been requested.

    Args:
        is_own_process: whether to handle the signals; ignored ones, as under ``nohup``, stay ignored.
    """

    def __init__(self, is_own_process: bool) -> None:
        self._is_loading = True
        self._number: int | None = None
        for number in _NUMBERS if is_own_process else ():
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    @property
    def exit_code(self) -> int:
        """As in shells, 128 plus the signal's number; 0: no request."""
        return 0 if self._number is None else 128 + self._number

    def has_loaded(self) -> None:
        """From now on there may be something to clean up."""
        self._is_loading = False

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        if self._is_loading:
            os.write(2, b"rotavg: interrupted\n")
            os._exit(128 + number)  # an exception during an import would look like that module's fault
        self._number = number
        raise KeyboardInterrupt
