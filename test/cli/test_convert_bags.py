from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import read_graph, write_graph
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World


@pytest.fixture
def graph_path(tmp_path: Path) -> Path:
    config = SlamSimulationConfig(world=World.SPHERE, dimensions=3, num_keyframes=200)
    run = simulate_slam_graph(config, np.random.default_rng(0))
    write_graph(tmp_path / "graph.g2o", run.to_graph_file())
    return tmp_path / "graph.g2o"


def test_file_to_bag_and_back(tmp_path: Path, graph_path: Path) -> None:
    bag = tmp_path / "bag"
    assert main(["convert", str(graph_path), str(bag)]) == 0
    assert (bag / "metadata.yaml").exists()
    assert main(["convert", str(bag), str(tmp_path / "back.g2o")]) == 0
    before, after = read_graph(graph_path), read_graph(tmp_path / "back.g2o")
    for name in ("source", "target", "kind"):
        assert torch.equal(getattr(before.graph, name), getattr(after.graph, name))
    difference = before.graph.target_from_source - after.graph.target_from_source
    assert float(difference.abs().max()) < 1e-9
    np.testing.assert_allclose(after.graph.precision, before.graph.precision, rtol=1e-9)
    np.testing.assert_allclose(after.edge_translation, before.edge_translation, atol=1e-9)


def test_an_existing_output_is_kept(tmp_path: Path, graph_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = str(tmp_path / "bag")
    assert main(["convert", str(graph_path), bag]) == 0
    capsys.readouterr()
    assert main(["convert", str(graph_path), bag]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["convert", str(graph_path), bag, "--overwrite"]) == 0


@pytest.mark.parametrize("name", ["run.2024", "v1.2", "2024-01-31T12.30.05"])
def test_a_folders_name_may_end_in_a_number(tmp_path: Path, graph_path: Path, name: str) -> None:
    assert main(["convert", str(graph_path), str(tmp_path / name)]) == 0
    assert (tmp_path / name / "metadata.yaml").exists()
    assert main(["convert", str(tmp_path / name), str(tmp_path / "back.g2o")]) == 0


@pytest.mark.parametrize("inside", ["bag.mcap", "graph.g2o", "stamps.txt"])
def test_a_bag_with_an_input_in_it_is_kept(
    tmp_path: Path, graph_path: Path, capsys: pytest.CaptureFixture[str], inside: str
) -> None:
    bag = tmp_path / "bag"
    assert main(["convert", str(graph_path), str(bag)]) == 0
    within = bag / inside
    if inside != "bag.mcap":
        within.write_bytes(graph_path.read_bytes())
    words = [str(graph_path), "--stamps", str(within)] if inside == "stamps.txt" else [str(within)]
    before = {path: path.read_bytes() for path in bag.iterdir()}
    capsys.readouterr()
    assert main(["convert", *words, str(bag), "--overwrite"]) == 2
    assert f"{bag}: would be replaced, and {within} is in it; choose another OUTPUT" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in bag.iterdir()} == before


@pytest.mark.parametrize("name", ["nothing", "nothing.mcap", "nothing.bag"])
def test_a_bag_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert main(["convert", str(tmp_path / name), str(tmp_path / "x.g2o")]) == 2
    error = capsys.readouterr().err
    assert "no such" in error
    assert error.count("\n") == 1


def test_a_bag_without_edges(tmp_path: Path, capsys: pytest.CaptureFixture[str], shared_data: Path) -> None:
    path = shared_data / "bags" / "nav2_turtlebot.mcap"
    assert main(["convert", str(path), str(tmp_path / "x.g2o")]) == 2
    assert "no topic /relative_rotations" in capsys.readouterr().err


def test_what_can_be_read_of_a_damaged_bag_is_converted(
    tmp_path: Path, graph_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", str(graph_path), str(tmp_path / "bag")]) == 0
    whole = (tmp_path / "bag" / "bag.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    capsys.readouterr()
    assert main(["convert", str(cut), str(tmp_path / "half.g2o")]) == 0
    warning = capsys.readouterr().err
    assert warning.startswith(f"rotavg: warning: {cut}: the bag is damaged: cut.mcap is cut off, after ")
    assert warning.count("\n") == 1
    before, after = read_graph(graph_path), read_graph(tmp_path / "half.g2o")
    number = after.graph.num_edges
    assert before.graph.num_edges / 4 < number < before.graph.num_edges
    assert torch.equal(after.graph.source, before.graph.source[:number])
    cut.write_bytes(whole[:200])
    assert main(["convert", str(cut), str(tmp_path / "none.g2o")]) == 2
    assert capsys.readouterr().err.startswith(f"rotavg: error: {cut}: not a readable bag")
