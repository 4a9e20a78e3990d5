"""Whatever the user gets wrong: one line on stderr, exit code 2, no traceback, old outputs intact."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.cli.main import COMMANDS, main
from rotavg_ros.datasets.files.formats import read_graph, write_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.version import __version__

EDGES = "".join(f"EDGE_SE2 {i} {i + 1} 1 0 0.1 1 0 0 1 0 100\n" for i in range(5))
ROOT = Path(__file__).parents[2]


@pytest.fixture
def graph_path(tmp_path: Path) -> Path:
    path = tmp_path / "good.g2o"
    path.write_text(EDGES)
    return path


def refused(capsys: pytest.CaptureFixture[str], *command: object) -> str:
    """The one line that a refused command prints."""
    assert main([str(word) for word in command]) == 2
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("rotavg: error: ")
    assert captured.out == ""
    return lines[0].removeprefix("rotavg: error: ")


def python(program: str, *words: object, stdout: int = subprocess.PIPE) -> subprocess.CompletedProcess[str]:
    """A program in a process of its own that finds the package."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-B", "-c", program, *map(str, words)]
    return subprocess.run(command, env=environment, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)


ROTAVG = "import sys; from rotavg_ros.cli.main import main; sys.exit(main())"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "required: COMMAND; see rotavg --help"),
        (["frobnicate"], "invalid choice: 'frobnicate'"),
        (["solve"], "required: GRAPH, --output; see rotavg solve --help"),
        (["solve", "x.g2o"], "required: --output"),
        (["solve", "x.g2o", "--output", "out", "--profile", "x"], "invalid choice: 'x'"),
        (["solve", "x.g2o", "--output", "out", "--refine", "-1"], "must be 0 or more"),
        (["solve", "x.g2o", "--output", "out", "--refine", "many"], "--refine: 'many' is not a whole number"),
        (["solve", "x.g2o", "--output", "out", "--frob"], "unrecognized arguments: --frob; see rotavg solve --help"),
        (["solve", "x.g2o", "--output", "out", "--method", "magic"], "magic"),
        (["replay", "bag", "--output", "out", "--start", "1e300"], "--start: is 1e300; it must be 1e+12 or less"),
        (["replay", "bag", "--output", "out", "--duration", "1e300"], "--duration: is 1e300; it must be 1e+12 or less"),
    ],
)
def test_usage(capsys: pytest.CaptureFixture[str], words: list[str], message: str) -> None:
    assert message in refused(capsys, *words)


@pytest.mark.parametrize("words", [["--help"], ["--version"], *([command.name, "--help"] for command in COMMANDS)])
def test_help(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == 0
    output = capsys.readouterr().out
    assert output == f"rotavg {__version__}\n" if words == ["--version"] else "usage: rotavg" in output


HEAVY = ("torch", "numpy", "scipy", "matplotlib", "rosbags", "rclpy", "pandas", "yaml", "tqdm")


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["--version"],
        ["frobnicate"],
        ["solve", "my.g2o", "--output", "out", "--profile", "magic"],
        ["evaluate", "slam", "--help"],
        ["evaluate", "synthetic", "--recipes", "magic"],
        *([command.name, "--help"] for command in COMMANDS),
    ],
    ids=" ".join,
)
def test_help_and_mistakes_wait_for_nothing_heavy(words: list[str]) -> None:
    program = (
        "import sys; from rotavg_ros.cli.main import main\n"
        f"try: main({words!r})\n"
        f"except SystemExit: pass\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    assert python(program).stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (EDGES.replace("0.1", "nan", 1).encode(), ":1: a number that is not finite"),
        (EDGES.encode()[:-10], ":5: "),
        (b"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 0" + b" 1" * 21, ":1: a quaternion of length 0"),
        (b"NONSENSE 1 2 3\n", ":1: unknown tag 'NONSENSE'"),
        (bytes(range(256)) * 20, "unknown tag"),
        (b"PK\x03\x04" + bytes(100), "not an npz archive"),
        (b"0 1 2\n", ":1: 3 numbers where 14 belong"),
    ],
)
def test_bad_graph(capsys: pytest.CaptureFixture[str], tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.g2o"
    path.write_bytes(content)
    line = refused(capsys, "solve", path, "--output", tmp_path / "out")
    assert line.startswith(f"{path}:")
    assert message in line
    assert not (tmp_path / "out").exists()


def test_missing_and_directory(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "no such file" in refused(capsys, "solve", tmp_path / "none.g2o", "--output", tmp_path / "out")
    assert "is a directory" in refused(capsys, "solve", tmp_path, "--output", tmp_path / "out")


def test_one_bad_graph_among_good_ones(capsys: pytest.CaptureFixture[str], tmp_path: Path, graph_path: Path) -> None:
    bad = [tmp_path / "bad.g2o", tmp_path / "missing.g2o"]
    bad[0].write_text("EDGE_SE2 0 1\n")
    last = tmp_path / "last.g2o"
    last.write_text(EDGES)
    assert main(["solve", *map(str, [bad[0], graph_path, bad[1], last]), "--output", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    assert [line.split(":")[0] for line in captured.out.splitlines()] == [str(graph_path), str(last)]
    assert [line.split(" ")[2].split(":")[0] for line in captured.err.splitlines()] == list(map(str, bad))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["good", "last"]


def test_same_stem_twice(capsys: pytest.CaptureFixture[str], tmp_path: Path, graph_path: Path) -> None:
    twin = tmp_path / "folder" / "good.npz"
    line = refused(capsys, "solve", graph_path, twin, "--output", tmp_path / "out")
    assert str(graph_path) in line
    assert str(twin) in line
    assert not (tmp_path / "out").exists()
    assert "would both go to" in refused(capsys, "solve", graph_path, graph_path, "--output", tmp_path / "out")


def test_output_that_is_no_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path, graph_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for output in (tmp_path / "file", tmp_path / "file" / "below"):
        assert "is not a folder" in refused(capsys, "solve", graph_path, "--output", output)
    assert (tmp_path / "file").read_text() == "mine"


def test_folder_in_the_way_of_an_output(capsys: pytest.CaptureFixture[str], tmp_path: Path, graph_path: Path) -> None:
    (tmp_path / "out" / "edges.csv").mkdir(parents=True)
    assert "edges.csv is a folder" in refused(capsys, "solve", graph_path, "--output", tmp_path / "out")
    assert not (tmp_path / "out" / "orientations.csv").exists()


def test_graph_is_never_overwritten(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "edges.npz"
    write_graph(path, GraphFile.from_ids(np.array([0]), np.array([1]), np.array([[0.0, 0, 0, 1]])))
    assert "would be overwritten" in refused(capsys, "solve", path, "--output", tmp_path, "--edges", "npz")
    assert read_graph(path).graph.num_edges == 1


def test_unwritable_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path, graph_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        pytest.skip("this user may write everywhere, so permission cannot be denied")
    assert "permission denied" in refused(capsys, "solve", graph_path, "--output", locked / "out")


def test_full_disk_leaves_the_old_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph, out = tmp_path / "long.g2o", tmp_path / "out"
    graph.write_text("".join(f"EDGE_SE2 {i} {i + 1} 1 0 0.1 1 0 0 1 0 100\n" for i in range(2000)))
    assert main(["solve", str(graph), "--output", str(out)]) == 0
    capsys.readouterr()
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    # orientations.csv is the larger file: with this limit the first fits, with the smaller neither does.
    for limit in (1000, len(before["edges.csv"]) + 10):
        usual = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, usual[1]))
        try:
            told = refused(capsys, "solve", graph, "--output", out)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, usual)
        assert told.startswith(f"{out}: cannot be written: ")
        assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_paths_that_cannot_be_looked_at(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, graph_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    too_long, ring = tmp_path / ("x" * 300), tmp_path / "ring"
    ring.symlink_to(ring)
    for command in (
        ("solve", too_long, "--output", tmp_path / "out"),
        ("solve", graph_path, "--output", too_long),
        ("solve", graph_path, "--output", tmp_path / "out", "--weights", too_long),
        ("convert", too_long, tmp_path / "out.g2o"),
        ("convert", graph_path, too_long),
        ("convert", graph_path, tmp_path / f"{'x' * 300}.g2o"),
        ("replay", too_long, "--output", tmp_path / "out"),
        ("simulate", "--output", too_long),
        ("train", "clean-net", too_long, "--output", tmp_path / "out"),
    ):
        assert f"{'x' * 300}" in (line := refused(capsys, *command))
        assert "file name too long" in line.lower()
    for command in (
        ("solve", ring, "--output", tmp_path / "out"),
        ("solve", graph_path, "--output", ring),
        ("convert", ring, tmp_path / "out.g2o"),
        ("replay", ring, "--output", tmp_path / "out"),
    ):
        assert str(ring) in refused(capsys, *command)

    def denied(path: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "exists", denied)
    for command in (
        ("solve", graph_path, "--output", tmp_path / "out"),
        ("convert", graph_path, tmp_path / "out.g2o"),
        ("replay", tmp_path / "bag", "--output", tmp_path / "out"),
    ):
        assert "permission denied; check the" in refused(capsys, *command)


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, *(pytest.param(number, marks=pytest.mark.large) for number in (signal.SIGTERM, signal.SIGHUP))],
)
def test_interrupt(graph_path: Path, tmp_path: Path, number: signal.Signals) -> None:
    """While a graph is being read."""
    stuck = "import os, signal, time; from rotavg_ros.datasets.files import g2o"
    press = f"g2o.read = lambda path: (os.kill(os.getpid(), {number:d}), time.sleep(60))"
    result = python(f"{stuck}; {press}; {ROTAVG}", "solve", graph_path, "--output", tmp_path / "out")
    assert (result.returncode, result.stdout, result.stderr) == (128 + number, "", "rotavg: interrupted\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_while_loading(graph_path: Path, tmp_path: Path, number: signal.Signals) -> None:
    """Numpy takes an exception that comes out of an import of its own for a fault of the installation."""
    press = f"import os; importlib.import_module = lambda name: os.kill(os.getpid(), {number:d}) or time.sleep(60)"
    result = python(f"import importlib, time; {press}; {ROTAVG}", "solve", graph_path, "--output", tmp_path / "out")
    assert (result.returncode, result.stdout, result.stderr) == (128 + number, "", "rotavg: interrupted\n")


def test_interrupt_in_compiled_code(graph_path: Path, tmp_path: Path) -> None:
    """Python makes a SystemError of Ctrl-C where a function in C has its result just then; others are faults."""
    raising = """
from rotavg_ros.datasets.files import g2o
def read(path):
    try:
        raise SystemError from {}()
    except SystemError as error:
        raise SystemError("fault") from error
g2o.read = read
"""
    solve = "solve", graph_path, "--output", tmp_path / "out"
    result = python(f"{raising.format('KeyboardInterrupt')}\n{ROTAVG}", *solve)
    assert (result.returncode, result.stderr) == (130, "rotavg: interrupted\n")
    assert "SystemError: fault" in python(f"{raising.format('ValueError')}\n{ROTAVG}", *solve).stderr


@pytest.mark.large
def test_ignored_signals_stay_ignored(graph_path: Path, tmp_path: Path) -> None:
    """As ``nohup`` has it."""
    ignored = (
        "import os, signal; signal.signal(signal.SIGHUP, signal.SIG_IGN); from rotavg_ros.datasets.files import g2o"
    )
    press = "read = g2o.read; g2o.read = lambda path: os.kill(os.getpid(), signal.SIGHUP) or read(path)"
    result = python(f"{ignored}; {press}; {ROTAVG}", "solve", graph_path, "--output", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.large
def test_terminal_without_unicode(graph_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    result = python(ROTAVG, "solve", graph_path, "--output", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.parametrize("command", ["solve", "convert", "--help"])
def test_closed_pipe(graph_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    """No traceback, and not the exit code of a command that has done all: the second graph is not solved."""
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # most of it is then printed at the end
    second = tmp_path / "second.g2o"
    second.write_bytes(graph_path.read_bytes())
    words = {
        "solve": ("solve", graph_path, second, "--output", tmp_path / "out"),
        "convert": ("convert", graph_path, tmp_path / "graph.npz"),
    }.get(command, (command,))
    reader, writer = os.pipe()
    os.close(reader)
    result = python(ROTAVG, *words, stdout=writer)
    os.close(writer)
    assert (result.returncode, result.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's device that is always full")
def test_prints_on_a_full_disk(graph_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    with open("/dev/full", "w") as full:
        result = python(ROTAVG, "convert", graph_path, tmp_path / "graph.npz", stdout=full.fileno())
    complaint = "rotavg: error: what is printed cannot be written: No space left on device\n"
    assert (result.returncode, result.stderr) == (2, complaint)
    assert (tmp_path / "graph.npz").exists()
