"""``rotavg evaluate slam``: options, mistakes, what is written."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.cli import evaluate_slam
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.simulation.stress.kinds import REPORTING_SEEDS, TUNING_SEEDS
from rotavg_ros.evaluation.slam import pose_cases


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with one small planar graph: a chain, and closures across 20 keyframes."""
    source = np.concatenate((np.arange(79), np.arange(0, 60, 2)))
    target = np.concatenate((np.arange(1, 80), np.arange(20, 80, 2)))
    turn = 0.1 * (target - source) + np.radians(0.1) * np.random.default_rng(0).normal(size=len(source))
    rotation = rotations.exp(torch.from_numpy(np.stack((0 * turn, 0 * turn, turn), axis=1))).numpy()
    (tmp_path / "slam").mkdir()
    graph_file = GraphFile.from_ids(source, target, rotation, precision=np.full(len(source), 1e4), planar=True)
    write_graph(tmp_path / "slam" / "CSAIL.g2o", graph_file)
    return tmp_path


def test_report(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", "slam", "--data", str(data), "--output", str(data / "results"), "--threads", "1"]
    options = ["--graphs", "CSAIL", "--seeds", "1", "--shares", "0", "0.5", "--incremental", "CSAIL"]
    methods = ["--methods", "odometry", "chatterjee", "--no-peers", "--no-uncertainty", "--no-hard"]
    assert main([*command, *options, *methods]) == 0
    assert capsys.readouterr().out == f"{data / 'results' / 'slam.md'}\n"
    with (data / "results" / "slam-cases.csv").open() as file:
        rows = list(csv.DictReader(file))
    # Ratios need ours and the oracle, asked for or not.
    assert [row["method"] for row in rows] == ["neurora", "odometry", "chatterjee", "oracle"] * 2
    assert [row["condition"] for row in rows[::4]] == ["0 % random", "50 % random"]
    text = (data / "results" / "slam.md").read_text(encoding="utf-8")
    again = (
        "--graphs CSAIL --seeds 1 --shares 0 0.5 --no-hard --methods odometry chatterjee --no-peers --incremental CSAIL"
    )
    assert f"`rotavg evaluate slam --threads 1 {again} --no-uncertainty`" in text
    for file in (data / "results").glob("*.png"):
        assert f"({file.name})" in text
    assert "GNC" not in text.split("## CPU seconds")[0]


def test_no_suite_reports_on_seeds_for_tuning() -> None:
    for seeds in (evaluate_slam._RECORDED_SEEDS, REPORTING_SEEDS, pose_cases.REPORTING_SEEDS):
        assert not {*seeds} & {*TUNING_SEEDS}


def test_stress(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Kinds by parts of their names, the seeds that are for reporting; no data."""
    command = ["evaluate", "slam", "--suite", "stress", "--output", str(tmp_path), "--threads", "1"]
    assert main([*command, "--kinds", "15 closures", "3 WITNESSES", "--methods", "odometry", "--seeds", "1000"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'stress.md'}\n"
    with (tmp_path / "stress-cases.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["neurora", "odometry", "oracle"] * 6
    assert {row["seed"] for row in rows} == {"1000"}
    assert [row["kind"] for row in rows[-6::3]] == [
        f"lone slip: 3 witnesses, {places} of places" for places in ("one pair", "three pairs")
    ]
    again = "--suite stress --kinds '15 closures' '3 WITNESSES' --seeds 1000 --methods odometry"
    assert f"`rotavg evaluate slam --threads 1 {again}`" in (tmp_path / "stress.md").read_text(encoding="utf-8")


def test_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Simulated kinds need no data; ours and the oracle are always there, others' packages not with --no-peers."""
    command = ["evaluate", "slam", "--suite", "poses", "--output", str(tmp_path), "--threads", "1", "--no-peers"]
    kinds = ["--kinds", "SPARSE building: 30 % parallel", "--seeds", "1000"]
    assert main([*command, *kinds, "--methods", "gnc-true", "pcm", "neurora~cleannet"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'poses.md'}\n"
    with (tmp_path / "poses-cases.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == ["neurora", "pcm", "neurora~cleannet", "oracle"] * 2
    assert {(row["graph"], row["seed"]) for row in rows} == {("sparse building", "1000")}
    assert all(float(row["ate_m"]) > 0 for row in rows)
    text = (tmp_path / "poses.md").read_text(encoding="utf-8")
    assert "2 drawings (seeds 1000)" in text
    for file in tmp_path.glob("*.csv"):
        assert file.stem.startswith("poses-")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "name their folder with --data or $ROTAVG_DATA"),
        (["--data", "."], ".: lacks slam;"),
        (["--data", ".", "--uncertainty"], ".: lacks slam, slam/CSAIL.g2o, slam/intel.g2o"),
        (["--shares", "2"], "must lie between 0 and 1"),
        (["--seeds", "-1"], "must be 0 or more"),
        (["--graphs", "nowhere"], "invalid choice: 'nowhere'"),
        (["--data", ".", "--methods", "magic"], "unknown method 'magic'"),
        (["--suite", "worse"], "invalid choice: 'worse'"),
        (["--data", ".", "--kinds", "grid"], "--kinds chooses from the suites stress and poses; add --suite stress"),
        (["--suite", "stress", "--graphs", "CSAIL"], "with --suite stress use --kinds"),
        (["--suite", "stress", "--kinds", "nowhere"], "no kind's name contains 'nowhere'; names begin with building,"),
        (["--suite", "poses", "--kinds", "nowhere"], "no kind's name contains 'nowhere'; names begin with B25b_0.000,"),
        (["--suite", "poses", "--shares", "0.5"], "with --suite poses use --kinds"),
        (["--suite", "poses", "--sensitivity"], "--sensitivity needs cases of which all is known; add --suite stress"),
        (["--suite", "poses", "--methods", "gnc"], "unknown method 'gnc'; choose from neurora,"),
        (["--suite", "poses", "--kinds", "CSAIL"], "name their folder with --data or $ROTAVG_DATA"),
        (["--suite", "poses", "--kinds", "CSAIL", "--data", "."], ".: lacks slam;"),
    ],
)
def test_mistakes(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ROTAVG_DATA", raising=False)
    assert main(["evaluate", "slam", "--no-peers", "--no-uncertainty", "--output", str(tmp_path), *options]) == 2
    assert message in capsys.readouterr().err


def test_stress_tells_why_answers_are_wrong_and_what_parts_earn(tmp_path: Path) -> None:
    command = ["evaluate", "slam", "--suite", "stress", "--output", str(tmp_path), "--threads", "1", "--seeds", "1000"]
    command += ["--kinds", "drive: 26 closures, 16 agree exactly", "--methods", "odometry"]
    assert main([*command, "--without", "repeats", "--search-or-model"]) == 0
    with (tmp_path / "stress-cases.csv").open() as file:
        methods = [row["method"] for row in csv.DictReader(file)]
    assert methods == ["neurora", "odometry", "neurora~repeats", "oracle"]
    with (tmp_path / "stress-causes.csv").open() as file:
        everything, kind = csv.DictReader(file)
    assert (everything["kind"], everything["drawings"]) == ("all", "1")
    shares = [float(kind[f"{cause} %"]) for cause in ("right", "search", "model", "divided")]
    assert sum(shares) == pytest.approx(100, rel=1e-4)
    assert (tmp_path / "stress-calibration.csv").exists()


def test_why_answers_are_wrong_is_known_of_the_stress_suite_alone(
    data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "slam", "--data", str(data), "--output", str(data / "results"), "--search-or-model"]) == 2
    assert "--search-or-model needs cases of which all is known; add --suite stress" in capsys.readouterr().err
