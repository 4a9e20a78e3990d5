from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from rotavg_ros import solve
from rotavg_ros.cli.main import main
from rotavg_ros.cli.train import load_config
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.solver.networks import NETWORKS, PaperCleanNet, read_network
from rotavg_ros.solver.neurora.network_store import WEIGHTS_FOLDER, load_network
from rotavg_ros.training import sfm_tasks
from rotavg_ros.training.trainer import fingerprint

CPU = ("--device", "cpu", "--threads", "1")
OTHER_WEIGHTS = WEIGHTS_FOLDER / "sfm-clean-net.safetensors"
TINY = """
family: sfm
nodes: [12, 20]
graphs: 4
validation_nodes: [20, 20]
validation_graphs: 2
epochs: 2
batch_graphs: 2
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(TINY)
    return path


def test_clean_net_and_fine_net(config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "weights"
    assert main(["train", "clean-net", str(config), "--output", str(output), *CPU]) == 0
    assert "sfm-clean-net.safetensors: epoch" in capsys.readouterr().out
    assert main(["train", "fine-net", str(config), "--output", str(output), *CPU]) == 0
    card = json.loads((output / "sfm-fine-net.json").read_text())
    assert card["command"] == "rotavg train fine-net tiny"
    assert "mean_deg" in card["validation"]

    # The FineNet learned behind the CleanNet next to it; another one would make it another run.
    assert main(["train", "fine-net", str(config), "--output", str(output), *CPU]) == 0
    assert "going on after epoch 2 of 2" in capsys.readouterr().out
    (output / "sfm-clean-net.safetensors").unlink()
    assert main(["train", "fine-net", str(config), "--output", str(output), *CPU]) == 2
    assert "another clean_net_fingerprint" in capsys.readouterr().err


def test_clean_net_by_path(config: Path, tmp_path: Path) -> None:
    main(["train", "clean-net", str(config), "--output", str(tmp_path / "a"), *CPU])
    weights = tmp_path / "a" / "sfm-clean-net.safetensors"
    command = ["train", "fine-net", str(config), *CPU]
    assert main([*command, "--output", str(tmp_path / "a")]) == 0
    assert main([*command, "--output", str(tmp_path / "b"), "--clean-net", str(weights)]) == 0
    first, second = (load_file(tmp_path / name / "sfm-fine-net.safetensors") for name in "ab")
    assert all(torch.equal(first[key], second[key]) for key in first)


def test_the_card_of_robots_fine_net_states_no_dropout(tmp_path: Path) -> None:
    """It has none, whatever the default is."""
    config = tmp_path / "robots.yaml"
    config.write_text(
        "family: slam\nrecipe: robots\nnodes: [60, 80]\ngraphs: 1\nvalidation_nodes: [60, 80]\nvalidation_graphs: 1\n"
        "epochs: 1\nrobots:\n  worlds: [building]\n"
    )
    assert main(["train", "slam-fine-net", str(config), *CPU, "--output", str(tmp_path)]) == 0
    for card in (tmp_path / "slam-fine-net.json", WEIGHTS_FOLDER / "slam-fine-net.json"):
        assert json.loads(card.read_text())["config"]["edge_dropout"] == 0


def test_a_mean_over_more_steps_than_there_are_is_warned_of(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is kept is then next to untrained."""
    for averaging, warned in ((0.9, True), (0.2, False)):
        config.write_text(f"{TINY}averaging: {averaging}\n")
        assert main(["train", "clean-net", str(config), *CPU, "--output", str(tmp_path / str(averaging))]) == 0
        said = f"{config}: with averaging 0.9, 66 % of what is kept after all 4 steps are the weights before the first;"
        assert (said in capsys.readouterr().err) == warned


def test_the_packages_trainings_are_long_enough_for_their_means() -> None:
    for path in WEIGHTS_FOLDER.glob("*.json"):
        config = json.loads(path.read_text())["config"]
        steps = config["epochs"] * config["graphs"] / config["batch_graphs"]
        assert config.get("averaging", 0.0) ** steps < 1e-3


@pytest.mark.parametrize(
    ("network", "lines", "most"),
    [("slam-fine-net", "family: slam\nrecipe: robots\npasses: 3\n", 2), ("fine-net", "family: paper\npasses: 2\n", 1)],
)
def test_more_passes_than_a_network_learns_from_are_refused(
    network: str, lines: str, most: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "many.yaml"
    config.write_text(lines)
    assert main(["train", network, str(config), *CPU, "--output", str(tmp_path / "out")]) == 2
    assert f"learns from {most} in a row at most" in capsys.readouterr().err


def test_training_goes_on_from_given_weights(config: Path, tmp_path: Path) -> None:
    start = WEIGHTS_FOLDER / "sfm-clean-net.safetensors"
    still = tmp_path / "still.yaml"
    still.write_text(TINY + "learning_rate: 1.0e-12\n")
    command = ["train", "clean-net", str(still), *CPU]
    assert main([*command, "--output", str(tmp_path / "out"), "--start", str(start)]) == 0
    before, after = load_file(start), load_file(tmp_path / "out" / "sfm-clean-net.safetensors")
    for key, value in before.items():
        torch.testing.assert_close(after[key], value, atol=1e-9, rtol=0)
    card = json.loads((tmp_path / "out" / "sfm-clean-net.json").read_text())
    assert card["start_fingerprint"] == fingerprint(load_network(NETWORKS["sfm-clean-net"]))
    # Without the start it would be another run.
    assert main([*command, "--output", str(tmp_path / "out")]) == 2


def test_the_network_that_a_training_starts_from_is_not_overwritten(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Overwritten by the first epoch, it could not be started from again, and the run could not be resumed."""
    start = tmp_path / "out" / "sfm-clean-net.safetensors"
    start.parent.mkdir()
    start.write_bytes(OTHER_WEIGHTS.read_bytes())
    command = ["train", "clean-net", str(config), *CPU, "--output", str(start.parent), "--start", str(start)]
    assert main(command) == 2
    assert f"{start}: is of another run and would be overwritten" in capsys.readouterr().err
    assert start.read_bytes() == OTHER_WEIGHTS.read_bytes()


def test_a_folder_of_another_run_is_refused_before_graphs_are_drawn(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Drawing takes minutes."""
    assert main(["train", "clean-net", str(config), *CPU, "--output", str(tmp_path)]) == 0

    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(sfm_tasks, "drawn_graphs", never)
    config.write_text(TINY + "seed: 3\n")
    assert main(["train", "clean-net", str(config), *CPU, "--output", str(tmp_path)]) == 2
    assert "of a run with another seed" in capsys.readouterr().err
    (tmp_path / "sfm-clean-net.checkpoint.safetensors").unlink()
    assert main(["train", "clean-net", str(config), *CPU, "--output", str(tmp_path)]) == 2
    assert "is of another run and would be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["clean-net"], "clean-net has no configuration of its name; give a YAML file or one of paper-clean-net"),
        (["clean-net", "nothing"], "nothing: no such file; the package's own are paper-clean-net"),
        (["fine-net", "slam-clean-net"], "FineNet of robots' graphs needs `recipe: robots`"),
        (["clean-net", "slam-clean-net", "--device", "cuda"], "on the CPU"),
        (["clean-net", "sfm-clean-net", "--clean-net", "x"], "--clean-net is for fine-net"),
        (["fine-net", "sfm-fine-net", "--clean-net", "x.safetensors"], "x.safetensors: missing"),
        (["clean-net", "sfm-clean-net-broad"], "`rotavg train clean-net sfm-clean-net` makes; name them with --start"),
        (["fine-net", "sfm-fine-net-settled", "--start", "x.safetensors"], "x.safetensors: missing"),
        (["fine-net", "sfm-fine-net", "--start", str(OTHER_WEIGHTS)], '"network": "sfm-clean-net"'),
        (["fine-net", "sfm-fine-net", "--start", str(WEIGHTS_FOLDER)], "is a folder, need sfm-fine-net.safetensors"),
        (["clean-net", str(WEIGHTS_FOLDER)], "cannot be read (Is a directory)"),
        (["fine-net", "slam-clean-net", "--start", str(OTHER_WEIGHTS)], "needs `recipe: robots`"),
        (["clean-net", "sfm-clean-net", "--truth", "x.csv"], "--truth is for slam"),
        (["clean-net", "sfm-clean-net", "--threads", "0"], "must be 1 or more"),
        (["big-net", "sfm-clean-net"], "big-net"),
    ],
)
def test_mistakes_take_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", *words, "--output", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("rotavg: error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("epochz: 3", "unknown key 'epochz'"),
        ("nodes: 3", "nodes is 3"),
        ("nodes: [60, 2000000]", "nodes is [60, 2000000]; use an ascending pair of 10 to 20000"),
        ("- 1", "expected `key: value` lines"),
        ("family: cars", "family is 'cars'"),
        ("epochs: {", "not a readable YAML file"),
        ("goes_on_from: 2024-13-45", "not a readable YAML file"),
        ("nodes: " + "[" * 5000 + "]" * 5000, "is nested too deeply"),
        ("learning_rate: .nan", "learning_rate is nan"),
        ("seed: -1", "seed is -1"),
        ("seed: 18446744073709551616", "it must be a whole number from 0 to 2⁶⁴ - 1"),
        ("epochs: 3\n\tgraphs: 4", "line 2"),
        ("graphs: .inf", "graphs is inf"),
        ("epochs: 3\nseed: 1\nepochs: 5", ":3: epochs is there already in line 1; leave one of them"),
    ],
)
def test_bad_configurations(text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    assert main(["train", "clean-net", str(path), "--output", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert f"{path}:" in error
    assert message in error and error.count("\n") == 1


def test_a_folder_of_a_configurations_name_is_not_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run into it can be resumed by the same command."""
    meant = load_config("sfm-clean-net")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sfm-clean-net").mkdir()
    assert load_config("sfm-clean-net") == meant


def test_output_that_is_a_file(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "clean-net", str(config), "--output", str(config), *CPU]) == 2
    assert "cannot be used as a folder" in capsys.readouterr().err


@pytest.mark.parametrize("taken", ["safetensors", "json", "log.jsonl", "checkpoint.safetensors"])
def test_a_folder_in_the_way_of_a_file(
    config: Path, tmp_path: Path, taken: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / f"sfm-clean-net.{taken}"
    folder.mkdir()
    assert main(["train", "clean-net", str(config), "--output", str(tmp_path), *CPU]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"rotavg: error: {folder}: ") and error.count("\n") == 1


def test_no_gpu(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["train", "clean-net", str(config), "--output", str(tmp_path / "out"), "--device", "cuda"]) == 2
    assert "no usable GPU" in capsys.readouterr().err


def test_the_papers_networks(config: Path, tmp_path: Path) -> None:
    """Both, into a folder that then serves as weights of the paper's methods alone."""
    of_paper = config.with_name("paper.yaml")
    of_paper.write_text(config.read_text().replace("family: sfm", "family: paper"))
    for network in ("clean-net", "fine-net"):
        assert main(["train", network, str(of_paper), "--output", str(tmp_path / "weights"), *CPU]) == 0
    card = json.loads((tmp_path / "weights" / "paper-fine-net.json").read_text())
    assert card["clean_net_fingerprint"] == fingerprint(
        read_network(PaperCleanNet, tmp_path / "weights" / "paper-clean-net.safetensors")
    )
    sample = PaperRecipe(cameras=(15, 15), pair_share=(0.6, 0.6)).sample(np.random.default_rng(0))
    for method, is_used in (("neurora-paper", True), ("neurora-v1", False)):
        trained, packaged = (
            solve(sample.graph, profile="sfm", method=method, weights=weights).body_from_world
            for weights in (tmp_path / "weights", None)
        )
        assert torch.allclose(trained, packaged) != is_used
