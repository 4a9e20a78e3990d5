from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.bags.graph_from_bag import read_graph_bag
from rotavg_ros.cli.main import main, parse
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.metrics import true_edge_noise


def simulate(folder: Path, *options: str) -> GraphFile:
    assert main(["simulate", "--output", str(folder), "--laps", "2", *options]) == 0
    return read_graph_bag(folder)


def share_of_false_closures(graph_file: GraphFile) -> float:
    import torch

    graph = graph_file.graph
    truth = torch.from_numpy(graph_file.body_from_world_gt)
    noise = true_edge_noise(graph, truth).numpy()
    return float((noise[~graph.is_odometry.numpy()] > np.radians(10)).mean())


@pytest.mark.parametrize(
    ("world", "dimensions"),
    [
        ("building", "2"),
        ("city", "3"),
        *(pytest.param(*case, marks=pytest.mark.large) for case in (("building", "3"), ("city", "2"))),
    ],
)
def test_a_run_as_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str], world: str, dimensions: str) -> None:
    options = ["--world", world, "--dimensions", dimensions, "--false-share", "0.4", "--grouped"]
    run = simulate(tmp_path / "run", *options)
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'run'}: ")
    assert run.planar == (dimensions == "2")
    assert share_of_false_closures(run) == pytest.approx(0.4, abs=0.05)
    assert (np.diff(run.stamps_ns) == 100_000_000).all()
    speed = np.linalg.norm(np.diff(run.position_gt, axis=0), axis=1) / 0.1
    assert 0.1 < np.median(speed) < 8
    # Smooth motion: the body never turns faster than a robot can.
    turns = true_edge_noise_per_step(run)
    assert np.degrees(turns.max()) / 0.1 < 180


def true_edge_noise_per_step(run: GraphFile) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    body_from_world = Rotation.from_quat(run.body_from_world_gt)
    return (body_from_world[1:] * body_from_world[:-1].inv()).magnitude()


def test_same_seed_same_bag(tmp_path: Path) -> None:
    first, second = (simulate(tmp_path / name, "--seed", "5") for name in ("a", "b"))
    other = simulate(tmp_path / "c", "--seed", "6")
    np.testing.assert_array_equal(first.graph.target_from_source.numpy(), second.graph.target_from_source.numpy())
    assert not np.array_equal(first.position_gt, other.position_gt)


def test_the_graph_comes_with_it(tmp_path: Path) -> None:
    run = simulate(tmp_path / "run", "--graph", str(tmp_path / "run.npz"))
    graph = read_graph(tmp_path / "run.npz").graph
    assert graph.num_edges == run.graph.num_edges


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--false-share", "1.5"], "--false-share: is 1.5; it must lie between 0 and 1"),
        (["--laps", "0.5"], "laps is 0.5"),
        (["--closures-per-minute", "-3"], "--closures-per-minute: is -3; it must be 0 or more"),
        (["--closure-noise-deg", "nan"], "--closure-noise-deg: is nan"),
        (["--world", "moon"], "invalid choice: 'moon'"),
        (["--odometry-bias-deg-per-min", "inf"], "--odometry-bias-deg-per-min: is inf; it must be finite"),
        (["--seed", "-1"], "must be 0 or more"),
        (["--graph", "graph.unknown"], "unknown suffix '.unknown'"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], complaint: str
) -> None:
    assert main(["simulate", "--output", str(tmp_path / "run"), *options]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.startswith("rotavg: error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_a_graph_is_not_replaced_by_its_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate(tmp_path / "run")
    capsys.readouterr()
    graph = tmp_path / "run" / "graph.g2o"
    assert main(["simulate", "--output", str(tmp_path / "run"), "--overwrite", "--graph", str(graph)]) == 2
    said = capsys.readouterr().err
    assert said == f"rotavg: error: {graph}: is in the bag, which is written after it; choose another --graph\n"


def test_a_graph_and_a_bag_need_places_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = tmp_path / "run.g2o"
    assert main(["simulate", "--output", str(place), "--graph", str(place)]) == 2
    assert f"{place}: is the bag's place as well; choose another --graph" in capsys.readouterr().err
    assert not place.exists()


def test_an_existing_graph_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    graph = tmp_path / "graph.g2o"
    graph.write_text("mine")
    command = ["simulate", "--laps", "1", "--output", str(tmp_path / "run"), "--graph", str(graph)]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert said == f"rotavg: error: {graph}: exists already; choose another --graph or give --overwrite\n"
    assert graph.read_text() == "mine"
    assert not (tmp_path / "run").exists()
    assert main([*command, "--overwrite"]) == 0
    assert graph.read_text() != "mine"


@pytest.mark.parametrize("number", ["-2", "-0.5", "-.5", "-3.", "-1e-3", "-2.5E+1"])
def test_a_number_below_zero_is_no_option(number: str) -> None:
    parsed = parse(["simulate", "--output", "run", "--odometry-bias-deg-per-min", number])
    assert parsed.odometry_bias_deg_per_min == float(number)


def test_an_existing_bag_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulate(tmp_path / "run")
    assert main(["simulate", "--output", str(tmp_path / "run")]) == 2
    assert "--overwrite" in capsys.readouterr().err
    simulate(tmp_path / "run", "--overwrite")
