from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph

pytestmark = pytest.mark.ros

ROTAVG = [sys.executable, "-m", "rotavg_ros.cli.main"]
PATIENCE_S = 900.0  # 120 s were taken beside five busy processes


def test_a_simulated_run(tmp_path: Path, start_process: Callable) -> None:
    output = tmp_path / "demo"
    demo = start_process(*ROTAVG, "demo", "--output", output, "--laps", "2", "--seed", "1")
    assert demo.wait(PATIENCE_S) == 0, demo.output
    summary = json.loads((output / "summary.json").read_text())
    errors, false = summary["orientation_error_deg"], summary["false_closures"]
    assert errors["corrected"]["mean"] < errors["odometry"]["mean"] / 2
    assert false["precision"] >= 0.9
    assert false["recall"] >= 0.9
    assert summary["diagnostics"]["lost messages"] == "0"
    assert (output / "demo.png").stat().st_size > 50_000
    for words in ("orientation error", "false loop closures", "p95", "lost messages", "demo.png"):
        assert words in demo.output


@pytest.mark.large
def test_somebodys_own_graph_without_truth(tmp_path: Path, start_process: Callable) -> None:
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=200), np.random.default_rng(0))
    write_graph(tmp_path / "mine.g2o", run.to_graph_file())
    output = tmp_path / "demo"
    demo = start_process(*ROTAVG, "demo", "--graph", tmp_path / "mine.g2o", "--output", output, "--rate", "60")
    assert demo.wait(PATIENCE_S) == 0, demo.output
    summary = json.loads((output / "summary.json").read_text())
    assert summary["keyframes"] == 200
    assert summary["orientation_error_deg"] is None
    assert "no ground truth was given" in demo.output


def test_a_graph_without_odometry(tmp_path: Path, start_process: Callable) -> None:
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=40), np.random.default_rng(0)).to_graph_file()
    write_graph(tmp_path / "photos.txt", run)  # 1DSfM's format knows no odometry
    output = tmp_path / "demo"
    demo = start_process(*ROTAVG, "demo", "--graph", tmp_path / "photos.txt", "--output", output, "--rate", "60")
    assert demo.wait(PATIENCE_S) == 0, demo.output
    assert json.loads((output / "summary.json").read_text())["keyframes"] == 40


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--truth", "truth.csv"], "belong to --graph"),
        (["--graph", "nothing.g2o"], "no such file"),
        (["--graph", "mine.g2o", "--laps", "2"], "leave out --laps, which is for simulated runs"),
        (["--graph", "mine.g2o", "--grouped", "--seed", "4"], "leave out --grouped, --seed, which"),
        (["--laps", "0"], "--laps: is 0; it must be positive"),
        (["--rate", "nan"], "--rate: is nan; it must be 0 or more"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], complaint: str
) -> None:
    assert main(["demo", "--output", str(tmp_path / "demo"), *options]) == 2
    said = capsys.readouterr()
    assert complaint in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)
    assert not (tmp_path / "demo").exists()


def test_an_output_in_use_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.tex").write_text("")
    assert main(["demo", "--output", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err


def children_of(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_node_that_dies(tmp_path: Path, start_process: Callable, wait_until: Callable) -> None:
    demo = start_process(*ROTAVG, "demo", "--output", tmp_path / "demo", "--laps", "1")
    wait_until(lambda: "playing it" in demo.output and len(children_of(demo.pid)) > 0, demo)
    os.kill(children_of(demo.pid)[0], signal.SIGKILL)  # the node: the first process that the demo starts
    assert demo.wait(PATIENCE_S) == 2
    assert "the node died with exit code -9" in demo.output
    assert "Traceback" not in demo.output


@pytest.mark.large
def test_interrupted(tmp_path: Path, start_process: Callable, wait_until: Callable) -> None:
    demo = start_process(*ROTAVG, "demo", "--output", tmp_path / "demo", "--laps", "1")
    wait_until(lambda: len(children_of(demo.pid)) > 1, demo)
    children = children_of(demo.pid)
    for pid in (demo.pid, *children):  # as a terminal does
        os.kill(pid, signal.SIGINT)
    assert demo.wait() == 130
    assert "Traceback" not in demo.output
    assert demo.output.count("interrupted") == 1
    assert not any(Path(f"/proc/{child}").exists() for child in children), "nothing is left running"
