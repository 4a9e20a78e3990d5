"""Reserves a state file for one process: a lock on a file beside it, which the kernel releases with the process."""

from __future__ import annotations

import errno
import fcntl
import os
import threading
from contextlib import suppress
from pathlib import Path

from rotavg_ros.online.state.file import StateFileError, StateFileInUseError
from rotavg_ros.whole_file import real


class StateFileLock:
    """Held from :meth:`acquire` to :meth:`release`, or to the end of the process, however it ends.

    The file beside the state file holds the owner's process id. It is checked again whenever the state file is used,
    since folders may be moved or recreated.
    """

    def __init__(self, state_file: Path) -> None:
        self._state_file = state_file
        self._one_at_a_time = threading.Lock()
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the lock, or make sure that it is still held.

        Raises:
            StateFileInUseError: another process, or another node in this one, has it.
            StateFileError: the folder is missing or not writable.
        """
        with self._one_at_a_time:
            self._acquire(self._path)

    def _acquire(self, path: Path) -> None:
        if self._descriptor is not None and _is_file(path, self._descriptor):
            return
        self._close()
        try:
            while self._descriptor is None:
                self._descriptor = _locked(path)
        except BlockingIOError as error:
            raise StateFileInUseError(
                f"the state file {self._state_file} is in use by another node{_owner(path)}; "
                "give every node a state_file of its own"
            ) from error
        except OSError as error:
            raise StateFileError(f"cannot write the state file {self._state_file}: {error.strerror}") from error

    def release(self) -> None:
        """Release the lock, and leave no file behind."""
        with self._one_at_a_time:
            if self._descriptor is not None and _is_file(self._path, self._descriptor):
                with suppress(OSError):
                    self._path.unlink()
            self._close()

    @property
    def _path(self) -> Path:
        """Path of the lock file, beside the state file itself even if a link leads there."""
        place = real(self._state_file)
        return place.with_name(f".{place.name}.lock")

    def _close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def _locked(path: Path) -> int | None:
    """Open and lock; None if somebody has deleted the file in between.

    Raises:
        BlockingIOError: somebody else has it.
        OSError: it cannot be created or locked.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not _is_file(path, descriptor):
            os.close(descriptor)
            return None
        os.truncate(descriptor, 0)
        os.write(descriptor, f"{os.getpid()}\n".encode())
    except OSError as error:
        if error.errno == errno.ENOSPC:
            return descriptor  # locked all the same; only the owner's id is missing
        os.close(descriptor)
        raise
    return descriptor


def _is_file(path: Path, descriptor: int) -> bool:
    """Whether the descriptor belongs to the file that is now at this path."""
    try:
        there, ours = path.stat(), os.fstat(descriptor)
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)


def _owner(path: Path) -> str:
    try:
        owner = path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        owner = ""
    return f" (process {owner})" if owner.isdecimal() else ""
