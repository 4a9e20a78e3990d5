"""What all results in a folder need: the folder, and a line on what produced them."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import torch

from rotavg_ros.errors import UserError
from rotavg_ros.version import __version__


class ResultError(UserError):
    """Results that cannot be written."""


def make_folder(folder: Path) -> None:
    """Create a folder to write to before hours of work depend on it.

    Raises:
        ResultError: it cannot be created, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{folder}: cannot be used as a folder ({error.strerror}); choose another") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ResultError(f"{folder}: cannot be written (Permission denied); choose another")


def provenance() -> str:
    """What produced the figures: version, commit, machine."""
    return (
        f"rotavg_ros {__version__}, commit {commit()}; torch {torch.__version__}, {torch.get_num_threads()} of "
        f"{os.cpu_count()} CPU threads, {platform.machine()}"
    )


def commit() -> str:
    """Commit of the running sources, with "-dirty" if they have been changed since; "unknown" outside a checkout."""
    try:
        command = ["git", "describe", "--always", "--dirty"]
        result = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return result.stdout.strip()
