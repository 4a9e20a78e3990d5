"""Backups, beside a state file, of a state that it is about to lose."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from pathlib import Path

from rotavg_ros.online.state.file import Arrays, StateFileError, write
from rotavg_ros.whole_file import real

# Most backups that are kept: the newest one, and the largest of the others.
KEPT = 5
_NUMBERED = re.compile(r"\.bak-(\d+)$")


def back_up(state_file: Path, arrays: Arrays) -> Path:
    """Write a state into a new backup beside a state file; backups beyond :data:`KEPT` are deleted.

    If the path is a link, the backup is beside the file itself. Backups are numbered, not dated, since it is clocks set
    back that cause backups.

    Returns:
        the backup.

    Raises:
        StateFileError: the disk is full or the folder not writable. Then the state file itself, if there is one, has
            been renamed to the backup, so that the next save does not replace it; the message says so.
    """
    state_file = real(state_file)
    backup = _next(state_file)
    try:
        write(backup, arrays)
    except StateFileError as error:
        try:
            os.replace(state_file, backup)
        except OSError:
            raise error from None
        raise StateFileError(f"{error}; the last save is kept as {backup}") from error
    finally:
        _drop_surplus(state_file)
    return backup


def backups(state_file: Path) -> list[Path]:
    """The backups of a state file, the newest first."""
    state_file = real(state_file)
    numbered = {
        int(match.group(1)): path
        for path in state_file.parent.glob("*.bak-*")
        if (match := _NUMBERED.search(path.name)) and path.name.removesuffix(match.group()) == state_file.name
    }
    return [numbered[number] for number in sorted(numbered, reverse=True)]


def _next(state_file: Path) -> Path:
    known = backups(state_file)
    newest = _NUMBERED.search(known[0].name) if known else None
    return state_file.with_name(f"{state_file.name}.bak-{int(newest.group(1)) + 1 if newest else 1:04}")


def _drop_surplus(state_file: Path) -> None:
    """Delete surplus backups by size, so that an erratic clock cannot replace the one large map with small ones."""
    older = backups(state_file)[1:]
    with suppress(OSError):
        by_size = sorted(older, key=lambda path: path.stat().st_size, reverse=True)
        for path in by_size[KEPT - 1 :]:
            path.unlink()
