"""Finds the data sets of an evaluation."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from rotavg_ros.errors import UserError

_VARIABLE = "ROTAVG_DATA"


class DataFolderError(UserError):
    """The data sets were not named, or are not there."""


def add_data_argument(parser: argparse.ArgumentParser) -> None:
    """``--data``."""
    parser.add_argument("--data", type=Path, metavar="DIR", help=f"folder of the data sets (default: ${_VARIABLE})")


def data_folder(arguments: argparse.Namespace, needed: Sequence[str]) -> Path:
    """The folder named by ``--data`` or the environment.

    Args:
        needed: files and folders in it that an evaluation will read.

    Raises:
        DataFolderError: no folder is named, or it lacks something.
    """
    given: Path | None = arguments.data
    folder = given or (Path(os.environ[_VARIABLE]) if os.environ.get(_VARIABLE) else None)
    if folder is None:
        raise DataFolderError(
            f"the data sets are not part of the package; name their folder with --data or ${_VARIABLE}"
        )
    missing = [name for name in needed if not (folder / name).exists()]
    if missing:
        raise DataFolderError(f"{folder}: lacks {', '.join(missing)}; check --data or ${_VARIABLE}")
    return folder
