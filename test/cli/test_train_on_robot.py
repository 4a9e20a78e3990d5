"""`rotavg train slam --from`: what it prints, writes and refuses."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.solver.learning.fine_tuning import SlamFineNet
from rotavg_ros.solver.learning.robot_runs import RobotNoise
from rotavg_ros.solver.networks import load_network
from rotavg_ros.training import own_robot
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.own_robot import Verdict, family_of
from rotavg_ros.training.trainer import fingerprint

NOISE = RobotNoise(
    keyframes=400,
    planar=True,
    odometry_deg=0.3,
    closure_deg=1.0,
    closures_per_keyframe=0.4,
    false_share=0.2,
    grouped_share=0.5,
    step_spread=0.8,
    closure_spread=0.0,
    per_turn=0.0,
    common_share=0.0,
    states_precision=False,
)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def write_run(path: Path, seed: int, closures: float = 0.4) -> DrawnGraph:
    family = RobotFamily(
        ("building",), planar_share=1, closures_per_keyframe=(closures, closures), false_share=(0.2, 0.2)
    )
    drawn = family.drawn(150, np.random.default_rng(seed))
    write_graph(path, drawn.to_graph_file())
    return drawn


def write_truth(path: Path, drawn: DrawnGraph) -> None:
    quaternion = drawn.body_from_world * [-1, -1, -1, 1]  # files have world_from_body
    rows = np.column_stack((np.arange(len(quaternion)), quaternion))
    np.savetxt(path, rows, delimiter=",", header="id,qx,qy,qz,qw", comments="", fmt=["%d", *["%.17g"] * 4])


@pytest.mark.parametrize("is_better", [True, False])
def test_a_network_is_kept_only_if_it_is_better(
    is_better: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a run without and one with known truth; the verdict itself is tested below."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(own_robot, "_LEAST_RUNS", 4)
    monkeypatch.setattr(Verdict, "is_better", is_better)
    write_truth(Path("truth.csv"), write_run(Path("run.g2o"), 1))
    command = ["train", "slam", "--from", "run.g2o", "--truth", "truth.csv", "--minutes", "0.01", "--output", "robot"]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "run.g2o: planar; odometry " in told and "stretches held back" in told
    simulated = re.search(r"(\d+) simulated runs", told)
    card = json.loads(Path("robot/tried/slam-fine-net.json").read_text())
    assert simulated and card["config"]["graphs"] + card["config"]["validation_graphs"] == int(simulated[1])
    assert card["start_fingerprint"] == fingerprint(load_network(SlamFineNet))
    assert Path("robot/slam-fine-net.safetensors").exists() == is_better
    verdict = json.loads(Path("robot/verdict.json").read_text())
    assert verdict["kept"] == is_better and verdict["stretches"] > 1
    # With the number of runs and epochs that there was time for, the configuration is that of what was tried.
    written = TrainingConfig.load(Path("robot/tried/robots.yaml")).to_dict()
    by_time = {key: card["config"][key] for key in ("graphs", "validation_graphs", "epochs")}
    assert {**written, **by_time} == card["config"]
    assert written["nodes"] == [75, 150] and written["robots"]["planar_share"] == 1.0
    if is_better:
        assert main(["solve", "run.g2o", "--weights", "robot", "--output", "out"]) == 0
    assert main(command) == 2
    assert "is there from before" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["slam"], "slam fine-tunes on your runs and needs --from"),
        (["slam-fine-net", "--from", "run.g2o"], "other networks take none"),
        (["slam", "my.yaml", "--from", "run.g2o"], "slam takes no config"),
        (["slam", "--from", "run.g2o", "--device", "cuda"], "train on the CPU"),
        (["slam", "--from", "run.g2o", "--truth", "a.csv", "b.csv"], "--truth names 2 files, --from 1"),
        (["slam", "--from", "few.g2o"], "few.g2o: has .* closures?; need odometry and 12 closures at least"),
        (["slam-clean-net", "sfm-clean-net"], "is of the family sfm, slam-clean-net of the family slam"),
        (["slam-fine-net", "slam-clean-net"], "needs `recipe: robots`"),
    ],
)
def test_what_does_not_fit_is_refused(
    words: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_run(Path("run.g2o"), 1)
    write_run(Path("few.g2o"), 1, closures=0.04)
    assert main(["train", *words, "--output", "robot"]) == 2
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize("name", ["tried", "slam-fine-net.safetensors"])
def test_an_output_that_is_taken_is_told_of_before_the_runs_are_solved(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also by a network of before, which would be used though the verdict is that the package's is better."""
    there = tmp_path / "robot" / name
    there.mkdir(parents=True)
    command = ["train", "slam", "--from", str(tmp_path / "nowhere.g2o"), "--output", str(there.parent)]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert said == f"rotavg: error: {there}: is there from before; remove it or choose another --output\n"


@pytest.mark.parametrize("taken", ["verdict.json", "slam-fine-net.json"])
def test_a_folder_in_the_way_of_a_result(
    taken: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No network is left to be used then."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(own_robot, "_LEAST_RUNS", 4)
    monkeypatch.setattr(Verdict, "is_better", True)
    write_run(Path("run.g2o"), 1)
    (Path("robot") / taken).mkdir(parents=True)
    assert main(["train", "slam", "--from", "run.g2o", "--minutes", "0.01", "--output", "robot"]) == 2
    error = capsys.readouterr().err
    assert (
        error.startswith(f"rotavg: error: {Path('robot', taken).resolve()}: cannot be written (")
        and error.count("\n") == 1
    )
    assert not Path("robot/slam-fine-net.safetensors").exists()


def test_the_truth_of_another_run_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where two truths are given in another order than their runs; such errors would be simulated."""
    monkeypatch.chdir(tmp_path)
    drawn = [write_run(Path(f"{seed}.g2o"), seed) for seed in (1, 2)]
    for number, truth in zip((2, 1), drawn, strict=True):
        write_truth(Path(f"{number}.csv"), truth)
    command = ["train", "slam", "--from", "1.g2o", "2.g2o", "--truth", "1.csv", "2.csv", "--minutes", "0.01"]
    assert main([*command, "--output", "robot"]) == 2
    assert capsys.readouterr().err.startswith("rotavg: error: 1.csv: the errors above, by this truth, are too large")
    assert not Path("robot").exists()


def test_the_family_has_what_runs_show() -> None:
    family = family_of([NOISE])
    assert family.planar_share == 1.0
    assert family.odometry_deg == pytest.approx((0.2, 0.45))
    assert family.false_share == pytest.approx((0.1, 0.3))
    assert family.uneven > 0.5 > family.turns
    assert family.qualities < 0.1
    spatial = family_of([NOISE, RobotNoise(**{**NOISE.__dict__, "planar": False, "per_turn": 0.1})])
    assert spatial.planar_share == 0.5
    assert spatial.turns > 0.5
    assert spatial.per_turn[0] < 0.1 < spatial.per_turn[1]


def test_simulated_runs_have_closures_to_learn_from_where_those_of_a_long_run_are_rare() -> None:
    family = family_of([replace(NOISE, keyframes=4000, closures_per_keyframe=16 / 4000)])
    runs = [family.drawn(400, np.random.default_rng(seed)) for seed in range(20)]  # half of the most that are simulated
    assert min(int(run.is_closure.sum()) for run in runs) >= 12
    assert family_of([NOISE]).closures_per_keyframe == pytest.approx((0.4 / 1.5, 0.6))


@pytest.mark.parametrize("stretches", [2, 3, 16])
def test_a_network_that_is_no_better_is_seldom_kept(stretches: int) -> None:
    """By two standard errors alone one in seven is, of two stretches."""
    gains = np.random.default_rng(0).normal(size=(4000, stretches))
    errors = gains.std(axis=1, ddof=1) / np.sqrt(stretches)
    verdicts = [Verdict(gain, error, stretches, 0.0) for gain, error in zip(gains.mean(axis=1), errors, strict=True)]
    assert np.mean([verdict.is_better for verdict in verdicts]) == pytest.approx(0.023, abs=0.007)


def test_better_is_by_more_than_two_standard_errors() -> None:
    assert Verdict(0.1, 0.04, 10, 0.0).is_better
    assert Verdict(0.1, 0.049, 1000, 0.0).is_better
    assert not Verdict(0.1, 0.06, 10, 0.0).is_better
    assert not Verdict(0.0, 0.0, 1, 0.0).is_better
