"""A training run that is stopped and resumed is the run that was never stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file

from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.errors import UserError
from rotavg_ros.solver.networks import NETWORKS
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.network_store import read_network
from rotavg_ros.solver.neurora.paper import PaperCleanNet
from rotavg_ros.training import drawing
from rotavg_ros.training import trainer as trainer_module
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.paper_tasks import PaperCleanTask, PaperFineTask
from rotavg_ros.training.sfm_tasks import SfmCleanTask, SfmFineTask
from rotavg_ros.training.slam_fine_tasks import SlamFineTask
from rotavg_ros.training.slam_tasks import SlamCleanTask
from rotavg_ros.training.trainer import Trainer, TrainingTask, fingerprint

EPOCHS = 4
SFM = TrainingConfig(
    nodes=(12, 20), graphs=6, validation_nodes=(20, 20), validation_graphs=2, epochs=EPOCHS, batch_graphs=2, seed=5
)
FINE = replace(SFM, warmup_epochs=1, averaging=0.9, passes=2)
SLAM = TrainingConfig(
    family="slam",
    recipe="wide",
    nodes=(60, 120),
    graphs=4,
    validation_nodes=(100, 100),
    validation_graphs=2,
    epochs=EPOCHS,
    batch_graphs=2,
)
PAPER = replace(SFM, family="paper", recipe="paper", edge_dropout=0.25)
ROBOTS = replace(
    SLAM, recipe="robots", passes=2, robots=RobotFamily(worlds=("building", "grid"), false_share=(0.0, 0.2))
)
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """What is this small only waits for further threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def make_task(name: str) -> tuple[TrainingTask, TrainingConfig]:
    if name == "slam-clean-net":
        return SlamCleanTask(SLAM), SLAM
    if name == "slam-fine-net":
        return SlamFineTask(ROBOTS), ROBOTS
    if name == "sfm-clean-net":
        return SfmCleanTask(SFM, CPU), SFM
    if name == "paper-clean-net":
        return PaperCleanTask(PAPER, CPU), PAPER
    torch.manual_seed(0)
    if name == "paper-fine-net":
        return PaperFineTask(PAPER, CPU, PaperCleanNet()), PAPER
    return SfmFineTask(FINE, CPU, CleanNet()), FINE


def make_trainer(name: str, folder: Path) -> Trainer:
    return Trainer(*make_task(name), folder, name)


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    return {
        f"{path.name}:{key}": value
        for path in sorted(folder.glob("*.safetensors"))
        for key, value in load_file(path).items()
    }


def log(folder: Path, name: str) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / f"{name}.log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    "name",
    [
        *("sfm-clean-net", "slam-clean-net", "paper-fine-net"),
        *(pytest.param(name, marks=pytest.mark.large) for name in ("sfm-fine-net", "slam-fine-net", "paper-clean-net")),
    ],
)
def test_resumed_run_equals_unbroken_run_bit_for_bit(name: str, tmp_path: Path) -> None:
    make_trainer(name, tmp_path / "unbroken").run()
    make_trainer(name, tmp_path / "resumed").run(max_epochs=1)
    make_trainer(name, tmp_path / "resumed").run(max_epochs=2)
    resumed = make_trainer(name, tmp_path / "resumed")
    assert resumed.epochs_done == 3
    resumed.run()

    expected, actual = tensors(tmp_path / "unbroken"), tensors(tmp_path / "resumed")
    assert expected.keys() == actual.keys()
    assert any("exp_avg_sq" in key for key in expected)
    for key, value in expected.items():
        assert torch.equal(value, actual[key]), key
    assert log(tmp_path / "unbroken", name) == log(tmp_path / "resumed", name)


@pytest.mark.parametrize("interrupted", [".json", ".checkpoint.safetensors", ".safetensors"])
def test_kill_while_saving_loses_nothing(interrupted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "sfm-clean-net"
    make_trainer(name, tmp_path / "unbroken").run()
    trainer = make_trainer(name, tmp_path / "killed")
    trainer.run(max_epochs=1)

    class KilledError(BaseException):
        pass

    os_replace = os.replace

    def killed_before(source: Path, target: Path) -> None:
        if Path(target).name == name + interrupted:
            raise KilledError
        os_replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed_before)
        with pytest.raises(KilledError):
            trainer.run()
    read_network(NETWORKS[name], tmp_path / "killed" / f"{name}.safetensors")  # still a whole file

    make_trainer(name, tmp_path / "killed").run()
    expected, actual = tensors(tmp_path / "unbroken"), tensors(tmp_path / "killed")
    assert all(torch.equal(value, actual[key]) for key, value in expected.items())
    assert log(tmp_path / "unbroken", name) == log(tmp_path / "killed", name)


def test_best_weights_and_their_card_are_kept(tmp_path: Path) -> None:
    task, config = make_task("sfm-clean-net")
    objectives = iter([3.0, 1.0, 2.0, 1.5])
    task.validate = lambda: {"objective": next(objectives), "accuracy": 0.5}  # type: ignore[method-assign]
    trainer = Trainer(task, config, tmp_path, "sfm-clean-net", {"extra": "7"}, "rotavg train clean-net tiny")
    trainer.run(max_epochs=2)
    best = fingerprint(task.network)
    trainer.run()
    assert fingerprint(task.network) != best
    assert fingerprint(read_network(NETWORKS["sfm-clean-net"], trainer.weights_path)) == best

    card = trainer.card()
    assert card["epoch"] == 2
    assert card["validation"] == {"objective": 1.0, "accuracy": 0.5}
    assert card["config"] == config.to_dict()
    assert card["command"] == "rotavg train clean-net tiny"
    assert card["extra"] == "7"
    assert {"commit", "hardware", "hours", "torch", "version"} <= card.keys()


def test_kept_weights_are_the_mean_over_the_steps(tmp_path: Path) -> None:
    class Task:
        def __init__(self) -> None:
            self.network = torch.nn.Linear(1, 1, bias=False)
            self.own: list[torch.Tensor] = []

        def batches(self, rng: np.random.Generator) -> Iterator[dict[str, torch.Tensor]]:
            for _ in range(self.num_batches()):
                yield {"loss": (self.network.weight - 7).square().sum()}
                self.own.append(self.network.weight.detach().clone())

        def num_batches(self) -> int:
            return 5

        def validate(self) -> dict[str, float]:
            return {"objective": float((self.network.weight - 7).abs())}

    task = Task()
    mean = task.network.weight.detach().clone()
    Trainer(task, TrainingConfig(epochs=2, averaging=0.75, learning_rate=0.1), tmp_path, "tiny").run()
    assert len(task.own) == 10
    for weight in task.own:
        mean = 0.75 * mean + 0.25 * weight
    torch.testing.assert_close(load_file(tmp_path / "tiny.safetensors")["weight"], mean)
    assert torch.equal(task.network.weight, task.own[-1])


def test_finished_run_has_nothing_left_to_do(tmp_path: Path) -> None:
    make_trainer("sfm-clean-net", tmp_path).run()
    before = tensors(tmp_path)
    assert make_trainer("sfm-clean-net", tmp_path).run() == {}
    assert all(torch.equal(value, before[key]) for key, value in tensors(tmp_path).items())


def test_networks_share_a_folder(tmp_path: Path) -> None:
    for name in ("sfm-clean-net", "sfm-fine-net"):
        make_trainer(name, tmp_path).run(max_epochs=1)
    assert make_trainer("sfm-clean-net", tmp_path).epochs_done == 1
    assert make_trainer("sfm-fine-net", tmp_path).epochs_done == 1


def test_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    task, config = make_task("sfm-clean-net")
    Trainer(task, config, tmp_path, "sfm-clean-net").run(max_epochs=1)
    other = TrainingConfig(**{**vars(config), "seed": 6, "learning_rate": 1e-3})
    with pytest.raises(UserError, match="another learning_rate, seed"):
        Trainer(task, other, tmp_path, "sfm-clean-net")
    with pytest.raises(UserError, match="another clean_net_fingerprint"):
        Trainer(task, config, tmp_path, "sfm-clean-net", {"clean_net_fingerprint": "1"})


def test_checkpoint_of_another_network_is_refused(tmp_path: Path) -> None:
    make_trainer("sfm-fine-net", tmp_path).run(max_epochs=1)
    (tmp_path / "sfm-fine-net.checkpoint.safetensors").rename(tmp_path / "sfm-clean-net.checkpoint.safetensors")
    with pytest.raises(UserError, match="another network"):
        make_trainer("sfm-clean-net", tmp_path)


@pytest.mark.parametrize("content", [b"", b"no tensors", b"\x00" * 100])
def test_damaged_checkpoint_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "sfm-clean-net.checkpoint.safetensors").write_bytes(content)
    with pytest.raises(UserError, match=r"sfm-clean-net\.checkpoint\.safetensors: not a checkpoint"):
        make_trainer("sfm-clean-net", tmp_path)


def test_loss_that_is_no_number_stops_the_run(tmp_path: Path) -> None:
    task, config = make_task("sfm-clean-net")

    def batches(rng: np.random.Generator) -> Iterator[dict[str, torch.Tensor]]:
        yield {"loss": torch.tensor(float("nan"), requires_grad=True)}

    task.batches = batches  # type: ignore[method-assign]
    with pytest.raises(UserError, match="no number any more in epoch 0"):
        Trainer(task, config, tmp_path, "sfm-clean-net").run()
    assert not (tmp_path / "sfm-clean-net.safetensors").exists()


@pytest.mark.parametrize("objective", [float("nan"), float("inf")])
def test_validation_that_is_no_number_stops_the_run(objective: float, tmp_path: Path) -> None:
    task, config = make_task("sfm-clean-net")
    task.validate = lambda: {"objective": objective}  # type: ignore[method-assign]
    with pytest.raises(UserError, match="the validation's objective is no number any more in epoch 0; lower"):
        Trainer(task, config, tmp_path, "sfm-clean-net").run()
    assert not list(tmp_path.glob("*.safetensors"))


@pytest.mark.parametrize("suffix", [".safetensors", ".json"])
def test_a_checkpoint_without_the_best_weights_is_refused(suffix: str, tmp_path: Path) -> None:
    make_trainer("sfm-clean-net", tmp_path).run(max_epochs=1)
    before = log(tmp_path, "sfm-clean-net")
    (tmp_path / f"sfm-clean-net{suffix}").unlink()
    with pytest.raises(UserError, match=rf"sfm-clean-net\{suffix}: is missing; put it back, or remove sfm-clean-net"):
        make_trainer("sfm-clean-net", tmp_path)
    assert log(tmp_path, "sfm-clean-net") == before


@pytest.mark.parametrize("content", ["", "[1]", "{}"])
def test_a_checkpoint_beside_a_damaged_card_is_refused(content: str, tmp_path: Path) -> None:
    make_trainer("sfm-clean-net", tmp_path).run(max_epochs=1)
    (tmp_path / "sfm-clean-net.json").write_text(content)
    with pytest.raises(UserError, match=r"sfm-clean-net\.json: is damaged; put it back"):
        make_trainer("sfm-clean-net", tmp_path)


@pytest.mark.parametrize("card", ["kept", "damaged", "lost"])
def test_weights_of_another_run_are_not_overwritten(card: str, tmp_path: Path) -> None:
    """A network that was brought here, or whose checkpoint was removed, is lost with the first epoch otherwise."""
    make_trainer("sfm-clean-net", tmp_path).run(max_epochs=1)
    before = load_file(tmp_path / "sfm-clean-net.safetensors")
    (tmp_path / "sfm-clean-net.checkpoint.safetensors").unlink()
    if card == "damaged":
        (tmp_path / "sfm-clean-net.json").write_text("[")
    elif card == "lost":
        (tmp_path / "sfm-clean-net.json").unlink()
    task, config = make_task("sfm-clean-net")
    with pytest.raises(
        UserError, match=r"sfm-clean-net\.safetensors: is of another run and would be overwritten; move"
    ):
        Trainer(task, replace(config, seed=6), tmp_path, "sfm-clean-net")
    assert all(
        torch.equal(value, before[key]) for key, value in load_file(tmp_path / "sfm-clean-net.safetensors").items()
    )


def test_a_run_that_is_killed_before_its_first_checkpoint_begins_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(trainer_module, "save_checkpoint", killed)
        with pytest.raises(KeyboardInterrupt):
            make_trainer("sfm-clean-net", tmp_path / "killed").run()
    assert (tmp_path / "killed" / "sfm-clean-net.safetensors").exists()
    for folder in ("killed", "unbroken"):
        make_trainer("sfm-clean-net", tmp_path / folder).run()
    expected, actual = tensors(tmp_path / "unbroken"), tensors(tmp_path / "killed")
    assert all(torch.equal(value, actual[key]) for key, value in expected.items())


def test_training_reduces_the_loss(tmp_path: Path) -> None:
    config = TrainingConfig(**{**vars(SFM), "epochs": 25, "learning_rate": 5e-3})
    Trainer(SfmCleanTask(config, CPU), config, tmp_path, "sfm-clean-net").run()
    losses = [row["loss"] for row in log(tmp_path, "sfm-clean-net")]
    assert losses[-1] < 0.7 * losses[0]


def test_a_stated_family_is_what_both_networks_of_robots_see() -> None:
    """All closures of one false share, in flat worlds alone."""
    family = RobotFamily(
        worlds=("building",), planar_share=1.0, false_share=(0.3, 0.3), closures_per_keyframe=(0.5, 0.5)
    )
    config = replace(SLAM, recipe="robots", robots=family)
    false = torch.cat([sample.is_false for sample in SlamCleanTask(config).samples])
    assert float(false.double().mean()) == pytest.approx(0.3, abs=0.05)
    runs = SlamFineTask(replace(config, graphs=2, validation_graphs=1)).runs
    assert all(run.first.told.components == 1 for run in runs)


@pytest.mark.parametrize("task", [SlamCleanTask, SlamFineTask])
def test_a_family_of_which_nothing_can_be_learned_is_refused(
    task: type[SlamCleanTask | SlamFineTask], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its runs have no closures; the training had drawn others for ever."""
    monkeypatch.setattr(drawing, "_MOST_IN_VAIN", 5)
    config = replace(ROBOTS, robots=RobotFamily(("building",), closures_per_keyframe=(0.001, 0.001)))
    with pytest.raises(UserError, match="of 5 simulated runs in a row none can be learned from: they have "):
        task(config)


def test_draws_that_give_nothing_are_left_out() -> None:
    given = iter([None, 1, None, None, 2, 3])
    assert drawing.drawn(2, lambda: next(given), "") == [1, 2]
    assert next(given) == 3


def test_the_guide_names_all_that_a_family_is_made_of() -> None:
    guide = (Path(__file__).parents[2] / "docs" / "train-on-your-noise.md").read_text()
    assert [field.name for field in fields(RobotFamily) if f"`{field.name}`" not in guide] == []


def test_a_family_survives_a_file(tmp_path: Path) -> None:
    path = tmp_path / "robots.yaml"
    path.write_text(yaml.safe_dump(ROBOTS.to_dict()))
    assert TrainingConfig.load(path) == ROBOTS
    path.write_text("family: slam\nrecipe: robots\nrobots:\n  worlds: [moon]\n")
    with pytest.raises(UserError, match=r"robots.yaml: robots: worlds is \['moon'\]; choose some of building"):
        TrainingConfig.load(path)
    path.write_text("family: slam\nrecipe: wide\nrobots:\n  planar_share: 1\n")
    with pytest.raises(UserError, match="robots is for `family: slam` and `recipe: robots`"):
        TrainingConfig.load(path)


@pytest.mark.parametrize(
    "line",
    [
        *("graphs: 2.5", "epochs: true", "nodes: [10.5, 20]", "learning_rate: true", "graphs: [3]"),
        *("goes_on_from:", "recipe: [wide]", "nodes: {12: 3, 20: 4}", 'nodes: "99"'),
    ],
)
def test_numbers_are_taken_as_they_are_or_not_at_all(line: str, tmp_path: Path) -> None:
    path = tmp_path / "robots.yaml"
    path.write_text(f"{line}\n")
    with pytest.raises(UserError, match=rf"robots.yaml: {line.split(':')[0]} is .*, expected like"):
        TrainingConfig.load(path)
    path.write_text("graphs: 20.0\nlearning_rate: 1\n")  # these say the same
    assert TrainingConfig.load(path) == TrainingConfig(graphs=20, learning_rate=1.0)
