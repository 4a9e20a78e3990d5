"""One file holds everything; half of it, or anything else, holds nothing."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import socket
import struct
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.errors import UserError
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.state import file as state_file
from rotavg_ros.online.state.backups import back_up, backups
from rotavg_ros.online.state.lock import StateFileLock
from rotavg_ros.view_graph import EdgeLabel
from rotavg_ros.whole_file import remove_leftovers

OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, keyframe_interval_s=0.3)
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def feed(estimator: OnlineEstimator, start: int, stop: int) -> None:
    for index in range(start, stop):
        rotation = Rotation.from_rotvec([0.01 * index, 0.3, 0.02 * index]).as_quat()
        estimator.add_odometry("röbot", 100_000_000 * index, rotation.tolist(), (0.1 * index, 0, 0))


def edge(edge_id: int, target: int, source: int = 0) -> EdgeMeasurement:
    return EdgeMeasurement(edge_id, KeyframeReference("röbot", source), KeyframeReference("röbot", target), IDENTITY)


@pytest.fixture
def filled(solver) -> OnlineEstimator:
    estimator = OnlineEstimator(OPTIONS, solver)
    feed(estimator, 0, 40)
    estimator.add_edge(edge(1, 10))
    estimator.add_edge(edge(2**64 - 2, 9))
    estimator.add_edge(edge(3, 16))  # waits
    estimator.add_odometry("röbot", 5, IDENTITY)
    estimator.label_edge("röbot", 1, EdgeLabel.REJECTED)
    assert estimator.tick() is not None
    feed(estimator, 40, 44)
    return estimator


def test_a_restart_goes_on_as_if_nothing_had_happened(filled, solver, tmp_path):
    path = tmp_path / "state.npz"
    filled.save(path)
    assert os.listdir(tmp_path) == ["state.npz"]
    restarted = OnlineEstimator(OPTIONS, solver)
    restarted.load(path)
    assert restarted.counts() == filled.counts()
    assert restarted.current_orientation("röbot") == pytest.approx(filled.current_orientation("röbot"))
    for estimator in (filled, restarted):
        feed(estimator, 44, 60)
        assert estimator.add_edge(edge(2**64 - 2, 9)) == "duplicate_edge"
        assert estimator.add_edge(edge(1, 12)) is None  # labelled by its id
    answers = [estimator.tick(force_cold=True) for estimator in (filled, restarted)]
    assert answers[0].version == answers[1].version == 2
    for name in ("keyframe_id", "stamp_ns", "edge_id", "outlier", "world_from_body", "source", "target"):
        np.testing.assert_allclose(*(getattr(answer, name) for answer in answers), atol=1e-15, err_msg=name)


def test_an_empty_state(solver, tmp_path):
    path = tmp_path / "state.npz"
    OnlineEstimator(OPTIONS, solver).save(path)
    estimator = OnlineEstimator(OPTIONS, solver)
    estimator.load(path)
    assert estimator.counts().keyframes == 0 and estimator.tick() is None


def test_foreign_and_damaged_files_are_refused_and_the_old_state_kept(filled, tmp_path):
    good = tmp_path / "good.npz"
    filled.save(good)
    content = good.read_bytes()
    before = filled.counts()
    arrays = state_file.read(good)
    np.savez(tmp_path / "foreign.npz", a=np.arange(3))
    np.savez(tmp_path / "object.npz", header=np.array([{}], dtype=object))
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps({"header": 1}))
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("not a state")
    for fraction in (0.1, 0.5, 0.9, 0.999):
        (tmp_path / f"half{fraction}.npz").write_bytes(content[: int(fraction * len(content))])
    for position in np.linspace(200, len(content) * 0.8, 25).astype(int).tolist():
        damaged = bytearray(content)
        damaged[position] ^= 0xFF
        (tmp_path / f"damaged{position}.npz").write_bytes(damaged)
    np.savez_compressed(tmp_path / "stream.npz", **arrays)
    with zipfile.ZipFile(tmp_path / "stream.npz") as archive:
        begin = archive.infolist()[0].header_offset + 30
    packed = (tmp_path / "stream.npz").read_bytes()
    name_and_extra = sum(struct.unpack("<HH", packed[begin - 4 : begin]))
    at = begin + name_and_extra
    (tmp_path / "stream.npz").write_bytes(packed[:at] + b"\xff" + packed[at + 1 :])
    for name, change in {
        "short": {"keyframe_id": arrays["keyframe_id"][:-1]},
        "wide": {"answered": np.zeros((2, 3))},
        "range": {"source": arrays["source"] + 1000},
        "twice": {"keyframe_id": arrays["keyframe_id"] * 0},
        "nan": {"target_from_source": arrays["target_from_source"] * np.nan},
        "robot": {"keyframe_robot": arrays["keyframe_robot"] + 7},
    }.items():
        state_file.write(tmp_path / f"{name}.npz", arrays | change)
    bad = sorted(set(tmp_path.glob("*.npz")) - {good})
    for path in [*bad, tmp_path / "missing.npz", tmp_path]:
        # Damage may hit what nobody reads (a date in the archive); then what is loaded is what was saved.
        expectation = contextlib.suppress(UserError) if "damaged" in path.name else pytest.raises(UserError, match=r".")
        with expectation:
            filled.load(path)
        assert filled.counts() == before, path


def test_another_format_version_is_named(filled, tmp_path):
    path = tmp_path / "state.npz"
    filled.save(path)
    arrays = state_file.read(path)
    header = json.loads(arrays["header"].tobytes()) | {"format_version": 99}
    state_file.write(path, arrays | {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)})
    with pytest.raises(UserError, match="state format 99"):
        filled.load(path)


def test_a_failed_save_leaves_the_old_file(filled, tmp_path, monkeypatch):
    path = tmp_path / "state.npz"
    filled.save(path)
    content = path.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(UserError, match="No space left"):
        filled.save(path)
    assert path.read_bytes() == content and os.listdir(tmp_path) == ["state.npz"]
    with pytest.raises(UserError, match="cannot write"):
        filled.save(Path("/nonexistent/folder/state.npz"))


def test_a_link_leads_to_the_file_as_before(filled, tmp_path):
    """A file on another disk: what is saved, backed up and left over lies there, and the lock goes on holding."""
    disk, link = tmp_path / "disk", tmp_path / "link.npz"
    disk.mkdir()
    link.symlink_to(disk / "state.npz")  # of a file that is still to be made
    lock, other = StateFileLock(link), StateFileLock(disk / "state.npz")
    lock.acquire()
    filled.save(link)
    feed(filled, 44, 60)
    filled.save(link)
    assert link.is_symlink() and sorted(os.listdir(disk)) == [".state.npz.lock", "state.npz"]
    assert state_file.read(disk / "state.npz")["odometry0_stamp_ns"][-1] == 5_900_000_000
    lock.acquire()
    with pytest.raises(UserError, match="in use"):
        other.acquire()
    lock.release()
    assert back_up(link, state_file.read(link)) == disk / "state.npz.bak-0001" == backups(link)[0]
    (disk / ".state.npz.x8_k.tmp").write_bytes(b"half")
    remove_leftovers(link)
    assert sorted(os.listdir(disk)) == ["state.npz", "state.npz.bak-0001"]


@pytest.mark.parametrize("mode", [0o600, 0o664, 0o444])
def test_a_file_keeps_its_rights(filled, tmp_path, mode):
    path = tmp_path / "state.npz"
    filled.save(path)
    (tmp_path / "any").touch()
    assert path.stat().st_mode == (tmp_path / "any").stat().st_mode, "as the umask has it"
    path.chmod(mode)
    filled.save(path)
    assert path.stat().st_mode & 0o777 == mode


@pytest.mark.parametrize("kind", ["a folder", "a FIFO", "a socket", "a device"])
def test_what_is_no_file_is_refused_at_once(filled, tmp_path, kind):
    """A FIFO would keep the node waiting for somebody who writes into it."""
    path = tmp_path / "state"
    if kind == "a folder":
        path.mkdir()
    elif kind == "a FIFO":
        os.mkfifo(path)
    elif kind == "a socket":
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(str(path))
    else:
        path.symlink_to("/dev/null")
    for refused in (state_file.check_kind, filled.save) + (() if kind == "a socket" else (filled.load,)):
        with pytest.raises(UserError, match=f"state is {kind}"):
            refused(path)
    with pytest.raises(UserError):
        filled.load(path)


def test_what_a_killed_process_left_behind_is_removed(filled, tmp_path):
    path = tmp_path / "state.npz"
    filled.save(path)
    for name in (".state.npz.x8_k.tmp", ".other.npz.x8_k.tmp", "state.npz.tmp"):
        (tmp_path / name).write_bytes(b"half")
    remove_leftovers(path)
    assert sorted(os.listdir(tmp_path)) == [".other.npz.x8_k.tmp", "state.npz", "state.npz.tmp"]


KILL = """
import os, random, signal, sys, time, threading
from pathlib import Path
import numpy as np, torch
torch.set_num_threads(1)
from rotavg_ros.online import EstimatorOptions, OnlineEstimator

path, draw = Path(sys.argv[1]), random.Random(7)
options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0)
warm = OnlineEstimator(options)
[warm.add_odometry("r", 10_000_000 * index, (0.0, 0.0, 0.0, 1.0)) for index in range(9)]
assert warm.tick() is not None  # the networks are loaded before the processes part

def work(pipe):
    online = OnlineEstimator(options)
    if path.exists():
        online.load(path)
    threading.Thread(target=lambda: [online.tick(force_cold=True) for _ in iter(int, 1)], daemon=True).start()
    first = online.counts().keyframes
    for index in range(first, first + 100_000):
        turn = 0.001 * index
        online.add_odometry("r", 10_000_000 * index, (0.0, 0.0, np.sin(turn), np.cos(turn)))
        if index % 20 == 0:
            count = online.counts().keyframes
            online.save(path)
            os.write(pipe, count.to_bytes(4, "little"))

saved = 0
for _ in range(20):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        work(writer)
    os.close(writer)
    told = os.read(reader, 4) if draw.random() < 0.7 else b""  # the others may be killed while they load
    time.sleep(draw.uniform(0.005, 0.08))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    told += os.read(reader, 1 << 20)
    os.close(reader)
    saved = int.from_bytes(told[-4:], "little") if told else saved
    if path.exists():
        online = OnlineEstimator(options)
        online.load(path)
        assert online.counts().keyframes >= saved, (online.counts().keyframes, saved)
print(saved)
"""


def test_killed_at_any_moment_only_what_came_since_the_last_save_is_lost(tmp_path):
    """Twenty processes, one after the other, that feed, solve and save, until SIGKILL at a random moment."""
    command = [sys.executable, "-c", KILL, tmp_path / "state.npz"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) > 20, "they got somewhere"


def test_options_may_differ_after_the_restart(filled, solver, tmp_path):
    filled.save(tmp_path / "state.npz")
    other = OnlineEstimator(replace(OPTIONS, keyframe_source="edges", gauge="identity"), solver)
    other.load(tmp_path / "state.npz")
    assert other.counts().keyframes == filled.counts().keyframes
    assert other.tick() is not None


def test_a_path_may_be_a_string(filled, solver, tmp_path) -> None:
    path = str(tmp_path / "state.npz")
    filled.save(path)
    again = OnlineEstimator(OPTIONS, solver)
    again.load(path)
    assert again.counts() == filled.counts()
