"""Files that are whole at any moment: written beside their place and moved into it."""

from __future__ import annotations

import glob
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_TEMPORARY = ".tmp"


def real(path: Path) -> Path:
    """Where a file lies, or will lie, whatever links lead there."""
    return Path(os.path.realpath(path))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """An empty file beside ``path`` that takes its place at the end of the block, and vanishes after an error.

    Links that lead to the file stay. It keeps its rights; a new one has those that the umask leaves to any file.

    Raises:
        OSError: the place cannot be written.
    """
    place = real(path)
    temporary = place.with_name(f".{place.name}.{secrets.token_hex(4)}{_TEMPORARY}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        try:
            mode = stat.S_IMODE((os.stat(place) if place.exists() else os.fstat(descriptor)).st_mode)
            os.fchmod(descriptor, mode | stat.S_IWUSR)  # before there is anything in it that others may not read
        finally:
            os.close(descriptor)
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, place)
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_leftovers(path: Path) -> None:
    """Delete what was being written beside a file when the process was killed."""
    place = real(path)
    for leftover in place.parent.glob(f".{glob.escape(place.name)}.*{_TEMPORARY}"):
        with suppress(OSError):
            leftover.unlink()
