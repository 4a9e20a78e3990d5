"""What users get wrong: one line, exit code 2, and no half-written file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.bags.message_types import ODOMETRY, typestore
from rotavg_ros.bags.messages import odometry_message
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.cli.main import main

PATIENCE_S = 300.0

WIND = "geometry_msgs/msg/Vector3Stamped"


def wind_message(stamp_ns: int):
    """Of a type that a replay has no use for."""
    types, header = (
        typestore().types,
        odometry_message(stamp_ns, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), "map").header,
    )
    return types[WIND](header=header, vector=types["geometry_msgs/msg/Vector3"](x=1.0, y=1.0, z=1.0))


def make_bag(folder: Path, count: int = 50, topic: str = "/odom", period_ns: int = 100_000_000) -> Path:
    """Odometry that drives straight on, and a topic of vectors."""
    with BagWriter(folder) as bag:
        bag.add_topic(topic, ODOMETRY)
        bag.add_topic("/wind", WIND)
        for index in range(count):
            stamp = 10**9 + index * period_ns
            pose = np.array([0.1 * index, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
            bag.write(topic, stamp, odometry_message(stamp, *pose, "odom"))
            bag.write("/wind", stamp, wind_message(stamp))
    return folder


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bag(tmp_path_factory.mktemp("small") / "small")


def truncated(folder: Path, small: Path) -> Path:
    content = (small / "small.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(content[: len(content) // 2])
    return folder / "cut.mcap"


def corrupted(folder: Path, small: Path) -> Path:
    content = bytearray((small / "small.mcap").read_bytes())
    middle = len(content) // 3
    content[middle : middle + 400] = bytes(range(200)) * 2
    (folder / "bad.mcap").write_bytes(content)
    return folder / "bad.mcap"


def zero_length(folder: Path, small: Path) -> Path:
    (folder / "zero.mcap").touch()
    return folder / "zero.mcap"


def without_messages(folder: Path, small: Path) -> Path:
    return make_bag(folder / "none", count=0)


def without_odometry(folder: Path, small: Path) -> Path:
    with BagWriter(folder / "wind") as bag:
        bag.add_topic("/wind", WIND)
        bag.write("/wind", 10**9, wind_message(10**9))
    return folder / "wind"


def unknown_compression(folder: Path, small: Path) -> Path:
    content = (small / "metadata.yaml").read_text()
    (folder / "small").mkdir()
    (folder / "small" / "small.mcap").write_bytes((small / "small.mcap").read_bytes())
    changed = content.replace("compression_format: ''", "compression_format: brotli")
    changed = changed.replace("compression_mode: ''", "compression_mode: file")
    (folder / "small" / "metadata.yaml").write_text(changed)
    return folder / "small"


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        (zero_length, "not a readable bag, or a truncated one"),
        (without_messages, "has no messages"),
        (without_odometry, "its topics: /wind (geometry_msgs/msg/Vector3Stamped)"),
        (unknown_compression, "brotli"),
    ],
)
def test_a_bag_that_cannot_be_replayed(
    tmp_path: Path, small: Path, capsys: pytest.CaptureFixture[str], broken: Callable[[Path, Path], Path], says: str
) -> None:
    bag = broken(tmp_path, small)
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report"]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.startswith("rotavg: error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("broken", "says"), [(truncated, "cut.mcap is cut off, after 2."), (corrupted, "bad.mcap: 1 chunk is corrupt")]
)
def test_what_can_be_read_of_a_damaged_bag_is_replayed(
    tmp_path: Path, small: Path, capsys: pytest.CaptureFixture[str], broken: Callable[[Path, Path], Path], says: str
) -> None:
    bag = broken(tmp_path, small)
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report"]) == 0
    error = capsys.readouterr().err
    assert error.startswith(f"rotavg: warning: {bag}: the bag is damaged: {says}") and error.count("\n") == 1
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["damage"] in error and summary["interrupted"] and summary["keyframes"] > 0
    assert (tmp_path / "out" / "trajectory.tum").exists()
    quick = ["--output", str(tmp_path / "told"), "-p", "solve_period_s:=100.0"]
    assert main(["replay", str(bag), *quick]) == 0
    assert f"not all of it: the bag is damaged: {says}" in (tmp_path / "told" / "report.html").read_text("utf-8")
    capsys.readouterr()
    assert main(["replay", str(bag), "--list"]) == 0
    assert capsys.readouterr().err.startswith(f"rotavg: warning: {bag}: the bag is damaged: ") or broken is corrupted


def test_the_bag_one_is_in_has_a_name(tmp_path: Path, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(small)
    assert main(["replay", ".", "--output", str(tmp_path / "out"), "-p", "solve_period_s:=100.0"]) == 0
    assert "<h1>small</h1>" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_nothing_it_was_given_is_overwritten(tmp_path: Path, small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = make_bag(tmp_path / "run")  # whose file has the name of the answer's
    truth = tmp_path / "out" / "trajectory.tum"
    truth.parent.mkdir()
    truth.write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    before = (bag / "run.mcap").read_bytes()
    for words in (
        [str(bag), "--output", str(bag)],
        [str(bag / "run.mcap"), "--output", str(bag / ".." / "run")],
        [str(small), "--reference", str(truth), "--output", str(truth.parent)],
    ):
        assert main(["replay", *words, "--overwrite", "--no-report"]) == 2
        assert "has the bag or a reference in it; choose another --output" in capsys.readouterr().err
    assert (bag / "run.mcap").read_bytes() == before and truth.read_text().startswith("1.0")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--odometry", "/odometry"], "no topic /odometry; candidates for odometry: /odom"),
        (["--odometry", "/wind"], "/wind is geometry_msgs/msg/Vector3Stamped, of which no odometry can be made"),
        (
            ["--odometry", "/odom:sensor_msgs/msg/Imu"],
            "/odom is nav_msgs/msg/Odometry and cannot be read as sensor_msg",
        ),
        (["--edges", "/odom:rtabmap_msgs/msg/MapGraph"], "and cannot be read as rtabmap_msgs/msg/MapGraph"),
        (["--reference", "/odom:geometry_msgs/msg/PoseStamped"], "and cannot be read as geometry_msgs/msg/PoseStamped"),
        (["--edges", "/loops"], "no topic /loops; candidates for relative rotations: none"),
        (["--reference", "truth.tum"], "truth.tum: no such file, and no topic of that name; candidates for a"),
        (["--odometry", "none"], "nothing to replay"),
        (["--start", "100"], "lasts 4.9 s"),
        (["--start", "-1"], "must be 0 or more"),
        (["-p", "keyframe_angel_deg:=3.0"], "did you mean keyframe_angle_deg?"),
        (["-p", "keyframe_angle_deg:=wide"], "-p: keyframe_angle_deg is 'wide'; it must be a number"),
        (["-p", "keyframe_angle_deg:=500"], "-p: keyframe_angle_deg is 500.0; it must be between 0 and 360"),
        (["-p", "keyframe_angle_deg"], "write name:=value"),
        (["-p", "profile:=slow"], "profile is 'slow'"),
        (["-p", "method:=magic"], "magic"),
        (["--params", "nothing.yaml"], "nothing.yaml: cannot be read: No such file"),
        (["--robots", "a", "b"], "give one robot per topic"),
    ],
)
def test_options_that_cannot_be(
    tmp_path: Path,
    small: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["replay", str(small), "--output", "out", "--no-report", *options]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_parameters_of_others_and_of_running_nodes_are_told_of(
    tmp_path: Path, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(
        "/**:\n  ros__parameters:\n    max_velocity: 3.0\n    use_sim_time: true\n    state_file: map.npz\n"
    )
    assert main(["replay", str(small), "--list", "--params", str(path)]) == 0
    assert capsys.readouterr().err.splitlines() == [
        f"rotavg: warning: {path}: unknown parameter max_velocity is ignored",
        "rotavg: warning: a replay has no use for state_file, which only a running node has",
    ]


def test_an_output_that_exists_is_refused_and_then_replaced(
    tmp_path: Path, small: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["replay", str(small), "--output", str(tmp_path / "out")]
    assert main(arguments) == 0
    mine = tmp_path / "out" / "notes.txt"
    mine.write_text("by hand")
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*arguments, "--overwrite", "--no-report"]) == 0
    names = {path.name for path in mine.parent.iterdir()}
    assert "notes.txt" in names
    assert "report.html" not in names  # of the older replay
    (tmp_path / "file").touch()
    assert main(["replay", str(small), "--output", str(tmp_path / "file"), "--overwrite"]) == 2


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("graph.g2o", "by hand"),
        ("orientations.csv", "by hand"),
        ("summary.json", "{}"),
        ("summary.json", '{"files": 3}'),
    ],
)
def test_what_no_replay_has_written_is_not_overwritten(
    tmp_path: Path, small: Path, capsys: pytest.CaptureFixture[str], name: str, content: str
) -> None:
    mine = tmp_path / "out" / name
    mine.parent.mkdir()
    mine.write_text(content)
    assert main(["replay", str(small), "--output", str(tmp_path / "out"), "--overwrite", "--no-report"]) == 2
    assert f"{mine} would be overwritten" in capsys.readouterr().err
    assert mine.read_text() == content
    assert list(mine.parent.iterdir()) == [mine]


def test_a_reference_that_loses_its_position_now_and_then(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for topic in ("/odom", "/ground_truth"):
            bag.add_topic(topic, ODOMETRY)
        for index in range(50):
            stamp, position = 10**9 + index * 10**8, np.array([0.1 * index, 0.01 * index**2, 0.0])
            for topic in ("/odom", "/ground_truth"):
                lost = topic == "/ground_truth" and index == 20
                message = odometry_message(stamp, position * (np.nan if lost else 1), np.array([0, 0, 0, 1.0]), "odom")
                bag.write(topic, stamp, message)
    assert main(["replay", str(tmp_path / "bag"), "--output", str(tmp_path / "out")]) == 0
    (said,) = json.loads((tmp_path / "out" / "summary.json").read_text())["robots"].values()
    assert said["position_error_rms_m"]["odometry"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("stamps", "known", "told"),
    [
        ((12.0, 13.0, 14.0), 3, "against few.tum at 3 of {} keyframes: orientation 0.00°"),
        ((12.5, 13.5), 0, "against few.tum: not compared, for it has nothing within 0.15 s of any keyframe"),
        (range(1, 51), None, "against few.tum: orientation 0.00°"),
    ],
)
def test_a_reference_of_few_keyframes_is_told_to_be_that(
    stamps: Iterable[float], known: int | None, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, reference = make_bag(tmp_path / "bag", period_ns=10**9), tmp_path / "few.tum"
    reference.write_text("".join(f"{stamp} {0.1 * (stamp - 1)} 0 0 0 0 0 1\n" for stamp in stamps))
    often = ["-p", "keyframe_distance_m:=0.05", "--no-report"]
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--reference", str(reference), *often]) == 0
    (said,) = json.loads((tmp_path / "out" / "summary.json").read_text())["robots"].values()
    assert said["keyframes"] > 40
    assert said["compared_keyframes"] == (said["keyframes"] if known is None else known)
    assert told.format(said["keyframes"]) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("1 2 3\n", "3 columns; expected TUM"),
        ("", "the file has no rows"),
        ("900.0 0 0 0 0 0 0 1\n901.0 0 0 0 0 0 0 1\n", "do not overlap the bag's"),
        ("1.5 0 0 0 0 0 0 9\n", "a quaternion of length 9"),
        ("2.0 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", ":2: a stamp earlier than the one before"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3, "3 poses without stamps, but 50 odometry messages"),
    ],
)
def test_a_reference_of_another_kind(
    tmp_path: Path,
    small: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    content: str,
    says: str,
) -> None:
    monkeypatch.setattr("rotavg_ros.replay.run.replay", lambda *_: pytest.fail("replayed first"))
    truth = tmp_path / "truth.txt"
    truth.write_text(content)
    output = ["--output", str(tmp_path / "out"), "--no-report"]
    assert main(["replay", str(small), *output, "--reference", str(truth)]) == 2
    error = capsys.readouterr().err
    assert f"{truth}" in error
    assert says in error
    assert not (tmp_path / "out").exists()


def test_a_file_that_is_no_reference_is_told_before_the_replay(
    tmp_path: Path, small: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    graph = tmp_path / "truth.g2o"
    graph.write_text("EDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1\n")
    monkeypatch.setattr("rotavg_ros.replay.run.replay", lambda *_: pytest.fail("replayed first"))
    assert main(["replay", str(small), "--output", str(tmp_path / "out"), "--reference", str(graph)]) == 2
    assert f"{graph}:1" in capsys.readouterr().err


def test_no_space_left(tmp_path: Path, small: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    # A limit on sizes would hit run.mcap, which is written first.
    monkeypatch.setattr("rotavg_ros.replay.outputs.write_csv", full)
    assert main(["replay", str(small), "--output", str(tmp_path / "out"), "--no-report"]) == 2
    assert "cannot be written: No space left on device" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# A replay that says when it waits for the third message, and waits for ever; the first one has made a keyframe.
WAITING = """
import sys, time
from pathlib import Path
from rotavg_ros.cli.main import main
from rotavg_ros.replay import run
note, waits = Path(sys.argv.pop(1)), []
def wait(moment, stop):
    waits.append(moment)
    if len(waits) == 3:
        note.touch()
        while not stop():
            time.sleep(0.01)
run._wait_until = wait
sys.exit(main())
"""


def interrupt_replay(bag: Path, output: Path, number: signal.Signals, *options: str) -> tuple[int, str, str]:
    """Begin to replay, and send a signal in the middle; the exit code and what was told."""
    note = output.with_name("waiting")
    command = [sys.executable, "-c", WAITING, str(note), "replay", str(bag), "--output", str(output), "--rate", "1"]
    process = subprocess.Popen(
        [*command, "--no-report", *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + PATIENCE_S
    while not note.exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(number)
    told, complaints = process.communicate(timeout=PATIENCE_S)
    return process.returncode, told, complaints


def test_ctrl_c_keeps_what_is_done(tmp_path: Path, small: Path) -> None:
    output = tmp_path / "out"
    code, told, complaints = interrupt_replay(small, output, signal.SIGINT)
    assert (code, complaints) == (130, "")
    assert "interrupted after" in told
    assert {path.name for path in output.iterdir()} >= {"run.mcap", "summary.json", "trajectory.tum"}
    assert not list(output.glob(".unfinished*"))


def test_an_interrupted_replay_is_written_although_the_reference_has_more_rows(tmp_path: Path, small: Path) -> None:
    truth, output = tmp_path / "truth.txt", tmp_path / "out"
    truth.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 50)
    code, _, complaints = interrupt_replay(small, output, signal.SIGINT, "--reference", str(truth))
    assert code == 130
    assert f"not compared with the reference {truth}: 50 poses without stamps, but" in complaints
    assert (output / "summary.json").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.large)])
def test_an_interrupted_replay_leaves_the_older_answer_alone(
    tmp_path: Path, small: Path, number: signal.Signals
) -> None:
    output = tmp_path / "out"
    assert main(["replay", str(small), "--output", str(output), "--no-report"]) == 0
    before = {path: path.read_bytes() for path in output.iterdir()}
    code, _, complaints = interrupt_replay(small, output, number, "--overwrite")
    assert (code, complaints) == (128 + number, "rotavg: interrupted\n")
    assert {path: path.read_bytes() for path in output.iterdir()} == before


@pytest.mark.large
def test_the_workplace_of_a_killed_replay_is_in_nobodys_way(tmp_path: Path, small: Path) -> None:
    output = tmp_path / "out"
    assert interrupt_replay(small, output, signal.SIGKILL)[0] == -signal.SIGKILL
    others = output / f".unfinished.{os.getppid()}"
    assert list(output.glob(".unfinished.*"))
    others.mkdir()  # of a replay that goes on
    assert main(["replay", str(small), "--output", str(output), "--no-report"]) == 2
    others.rmdir()
    assert main(["replay", str(small), "--output", str(output), "--no-report"]) == 0
    assert not list(output.glob(".unfinished.*"))
