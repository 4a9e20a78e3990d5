"""The process that solves, as the side that asks sees it: another interpreter, or a copy of this one.

A copy shares with this process what both have imported: torch takes its second or two of CPU time and its hundred
megabytes once instead of twice. But it may be made only while this process has no other threads.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Protocol

# With -c and -m Python looks for modules in the folder where it is started, first of all: a user's queue.py, say.
_SERVER = """\
import sys
sys.path[:] = [folder for folder in sys.path if folder]
from rotavg_ros.online.solver_process.process import serve
serve(int(sys.argv[1]))
"""


class ServerProcess(Protocol):
    """A process that serves, and this side's end of what connects both."""

    connection: Connection

    @property
    def pid(self) -> int:
        """Of the process."""

    def exit_code(self, timeout: float) -> int | None:
        """As :class:`subprocess.Popen` has it, once it has ended; None if it has not after so many seconds."""

    def close(self) -> None:
        """End it, in the middle of a solve as well."""


class Spawned:
    """Another interpreter, which takes a second or two to be ready."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            server = [sys.executable, "-c", _SERVER, str(theirs.fileno())]
            # Ctrl-C is for whoever asks, who ends this process itself.
            command = ["/bin/sh", "-c", 'trap "" INT; exec "$@"', "sh", *server]
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()])
        self.connection = Connection(ours.detach())

    @property
    def pid(self) -> int:
        return self._process.pid

    def exit_code(self, timeout: float) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout)
        return self._process.returncode

    def close(self) -> None:
        with suppress(OSError):
            self.connection.close()
        self._process.kill()
        self._process.wait()


class Forked:
    """A copy of this process, which must have no other threads yet."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            # A copy of this side's end must not stay open there, or it would not hear when this process has gone.
            self._process = get_context("fork").Process(target=_serve_as_copy, args=(ours, theirs), daemon=True)
            self._process.start()
        self.connection = Connection(ours.detach())

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def exit_code(self, timeout: float) -> int | None:
        self._process.join(timeout)
        return self._process.exitcode

    def close(self) -> None:
        with suppress(OSError):
            self.connection.close()
        self._process.kill()
        self._process.join()


def _serve_as_copy(ours: socket.socket, theirs: socket.socket) -> None:
    ours.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that this is a copy of
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
            signal.signal(number, signal.SIG_DFL)
    serve(theirs.detach())


def serve(descriptor: int) -> None:
    """Solve what comes from the other end of a socket, until nobody holds that any more."""
    from rotavg_ros.startup import loading

    with loading():
        from rotavg_ros.online.solver_process.server import Server
    with suppress(EOFError, OSError):
        Server(Connection(descriptor)).run()
    os._exit(0)
