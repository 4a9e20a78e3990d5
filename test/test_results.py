"""Folders for results, and what produced them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rotavg_ros.errors import UserError
from rotavg_ros.results import make_folder, provenance
from rotavg_ros.version import __version__


def test_a_folder_is_made_or_its_trouble_told(tmp_path: Path) -> None:
    make_folder(tmp_path / "new" / "folder")
    assert (tmp_path / "new" / "folder").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot be used as a folder .*; choose another"):
        make_folder(tmp_path / "file")


def test_provenance() -> None:
    assert provenance().startswith(f"rotavg_ros {__version__}, commit ")
