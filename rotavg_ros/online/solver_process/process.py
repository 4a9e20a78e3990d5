"""The process that solves, as seen by the process that asks: another interpreter, or a fork of this one.

A fork shares with this process what was imported: torch takes its second or two of CPU time and its hundred megabytes
once instead of twice. But it may be made only while this process has no other threads.
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

# With -c and -m Python first looks for modules in the folder where it is started, and might find a user's queue.py.
_SERVER = """\
import sys
sys.path[:] = [folder for folder in sys.path if folder]
from rotavg_ros.online.solver_process.process import serve
serve(int(sys.argv[1]))
"""


class ServerProcess(Protocol):
    """A process that serves, and this side's end of the connection."""

    connection: Connection

    @property
    def pid(self) -> int:
        """Process id."""

    def exit_code(self, timeout: float) -> int | None:
        """Exit code as in :class:`subprocess.Popen`; None if the process has not ended after ``timeout`` seconds."""

    def close(self) -> None:
        """End it, even in the middle of a solve."""


class Spawned:
    """Another interpreter, which takes a second or two to be ready."""

    def __init__(self) -> None:
        """Start it.

        Raises:
            OSError: there is no memory, process or file descriptor left for it.
        """
        ours, theirs = socket.socketpair()
        with ours, theirs:  # where it cannot be started, neither end is left
            server = [sys.executable, "-c", _SERVER, str(theirs.fileno())]
            # Ctrl-C is for the asking process, which ends this one itself.
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
    """A fork of this process, which must have no other threads yet."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            # This side's end must not stay open in the fork, or it would not notice when this process ends.
            self._process = get_context("fork").Process(target=_serve_as_copy, args=(ours, theirs), daemon=True)
            # Nor may a Ctrl-C end the fork before it ignores them.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                self._process.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) != signal.SIG_IGN:  # as nohup has it
            signal.signal(number, signal.SIG_DFL)
    serve(theirs.detach())


def serve(descriptor: int) -> None:
    """Solve what comes from the other end of a socket, until that is closed."""
    from rotavg_ros.startup import loading

    with loading():
        from rotavg_ros.online.solver_process.server import Server
    with suppress(EOFError, OSError):
        Server(Connection(descriptor)).run()
    os._exit(0)
