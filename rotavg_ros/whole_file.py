"""Files that are complete at any moment: written beside their place and then moved into it."""

from __future__ import annotations

import errno
import glob
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_TEMPORARY = ".tmp"


def real(path: Path) -> Path:
    """The path of a file, existing or not, with all links resolved."""
    return Path(os.path.realpath(path))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """An empty file beside ``path`` that takes its place at the end of the block, and is deleted after an error.

    Links to the file stay. It keeps its permissions; a new file gets the usual ones by the umask.

    Raises:
        OSError: the place cannot be written, or has what no file may take the place of.
    """
    place = real(path)
    if place.exists() and not (place.is_file() or place.is_dir()):  # moving a file onto a folder fails by itself
        raise FileExistsError(errno.EEXIST, "not a regular file (a pipe or a device); choose another")
    temporary = place.with_name(f".{place.name}.{secrets.token_hex(4)}{_TEMPORARY}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
    try:
        try:
            mode = stat.S_IMODE((os.stat(place) if place.exists() else os.fstat(descriptor)).st_mode)
            os.fchmod(descriptor, mode | stat.S_IWUSR)  # before anything is in it that others may not read
        finally:
            os.close(descriptor)
        yield temporary
        temporary.chmod(mode)
        os.replace(temporary, place)
    finally:
        with suppress(OSError):
            temporary.unlink()


def remove_leftovers(path: Path) -> None:
    """Delete temporary files beside a file, left by a process that was killed."""
    place = real(path)
    for leftover in place.parent.glob(f".{glob.escape(place.name)}.*{_TEMPORARY}"):
        with suppress(OSError):
            leftover.unlink()
