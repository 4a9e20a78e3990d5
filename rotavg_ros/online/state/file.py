"""The estimator's whole state in one npz file: arrays only, nothing is ever unpickled."""

from __future__ import annotations

import json
import os
import stat
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.errors import UserError
from rotavg_ros.whole_file import real, replacing

FORMAT = "rotavg online state"
FORMAT_VERSION = 8
_READABLE = (2, 3, 4, 5, 6, 7, FORMAT_VERSION)

Arrays = dict[str, NDArray[Any]]


class StateFileError(UserError):
    """A state file cannot be read or written; the message names it and says what to do."""


class StateFileInUseError(StateFileError):
    """Another node is using the state file."""


def check_kind(path: Path) -> None:
    """Refuse a path of something other than a file.

    Raises:
        StateFileError: a folder, a FIFO, a socket or a device.
    """
    with suppress(OSError):  # nothing there yet, or it may not be examined
        _check_kind(path, path.stat().st_mode)


def _check_kind(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}
        kind = kinds.get(stat.S_IFMT(mode), "a device")
        raise StateFileError(f"the state file {path} is {kind}; name a file, or one that is still to be written")


def _open(path: Path) -> BinaryIO:
    """Open for reading, without waiting for a writer if it is a FIFO."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _check_kind(path, os.fstat(descriptor).st_mode)
    except StateFileError:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


def write(path: Path, arrays: Arrays) -> None:
    """Write a state file, whole or not at all (:func:`~rotavg_ros.whole_file.replacing`), and flush it to the disk.

    Raises:
        StateFileError: the folder is missing or not writable, the disk is full, or the path is not that of a file.
    """
    check_kind(path)
    try:
        with replacing(path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
            stream.flush()
            os.fsync(stream.fileno())
        _synchronise(real(path).parent)
    except OSError as error:
        raise StateFileError(f"cannot write the state file {path}: {error.strerror}") from error


def _synchronise(folder: Path) -> None:
    """Flush the file's new name to the disk before anybody relies on it."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read(path: Path) -> Arrays:
    """The arrays of a state file, complete (every array carries a checksum) and of this format.

    Raises:
        StateFileError: missing, foreign, truncated, corrupted, or of another format version.
    """
    try:
        with _open(path) as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(arrays["header"].tobytes())
        if header["format"] != FORMAT:
            raise ValueError("another format")
        format_version = header["format_version"]
    except FileNotFoundError as error:
        raise StateFileError(f"there is no state file {path}; save one first") from error
    except OSError as error:
        raise StateFileError(f"cannot read the state file {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise StateFileError(
            f"{path} is not a whole state file of rotavg; if it is something else, name another file, and if it is "
            "damaged, delete it"
        ) from error
    if format_version not in _READABLE:
        raise StateFileError(
            f"{path} has state format {format_version}, this version reads {FORMAT_VERSION}; save a new one"
        )
    return arrays
