"""One state file, one node."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rotavg_ros.online.state.file import StateFileError, StateFileInUseError
from rotavg_ros.online.state.lock import StateFileLock

HOLD = """
import sys
from pathlib import Path
from rotavg_ros.online.state.lock import StateFileLock
lock = StateFileLock(Path(sys.argv[1]))
lock.acquire()
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "state.npz"


def test_a_second_one_is_refused_until_the_first_lets_go(path) -> None:
    first, second = StateFileLock(path), StateFileLock(path)
    first.acquire()
    first.acquire()
    with pytest.raises(StateFileInUseError, match=rf"{path} is in use by another node \(process {os.getpid()}\)"):
        second.acquire()
    first.release()
    second.acquire()
    second.release()
    assert list(path.parent.iterdir()) == []


def test_other_names_of_the_same_file(path, tmp_path) -> None:
    path.touch()
    (tmp_path / "link.npz").symlink_to(path)
    first, second = StateFileLock(path), StateFileLock(tmp_path / "link.npz")
    first.acquire()
    with pytest.raises(StateFileInUseError):
        second.acquire()
    other = StateFileLock(tmp_path / "other.npz")
    other.acquire()


def test_the_kernel_lets_go_for_a_process_that_was_killed(path) -> None:
    command = [sys.executable, "-c", HOLD, path]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout.readline() == "held\n"
        lock = StateFileLock(path)
        with pytest.raises(StateFileInUseError, match=f"process {holder.pid}"):
            lock.acquire()
        holder.kill()
        holder.wait()
        lock.acquire()
        lock.release()


def test_a_folder_that_is_moved_and_made_anew(tmp_path) -> None:
    folder = tmp_path / "states"
    folder.mkdir()
    first, second = StateFileLock(folder / "state.npz"), StateFileLock(folder / "state.npz")
    first.acquire()
    folder.rename(tmp_path / "gone")
    with pytest.raises(StateFileError, match="cannot write the state file"):
        first.acquire()
    folder.mkdir()
    second.acquire()
    with pytest.raises(StateFileInUseError):
        first.acquire()
    second.release()
    first.acquire()
