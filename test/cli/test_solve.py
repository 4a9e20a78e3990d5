"""`rotavg solve`: what it writes, checked by reading it back with the csv and json modules."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations, solve
from rotavg_ros.cli.main import main
from rotavg_ros.cli.solve import plan
from rotavg_ros.datasets.files.formats import read_graph, write_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.solver.neurora.network_store import WEIGHTS_FOLDER
from rotavg_ros.version import __version__


def pose_graph(num_nodes: int = 30, *, seed: int = 0) -> GraphFile:
    """A chain with closures, one of them false and one stored twice, new → old, and ids with gaps."""
    rng = np.random.default_rng(seed)
    body_from_world = rotations.random(num_nodes, generator=torch.Generator().manual_seed(seed))
    chain = np.arange(num_nodes - 1)
    source = np.concatenate((chain, rng.integers(15, num_nodes, 12)))
    target = np.concatenate((chain + 1, rng.integers(0, 12, 12)))
    source, target = np.append(source, source[-2:]), np.append(target, target[-2:])
    noise = rotations.exp(0.003 * torch.randn(len(source), 3, dtype=torch.float64))
    noise[num_nodes + 3] = rotations.exp(torch.tensor([0.0, 1.5, 0.0], dtype=torch.float64))
    exact = rotations.multiply(body_from_world[target], rotations.inverse(body_from_world[source]))
    ids = np.arange(num_nodes) + 100
    ids[20:] += 50
    measured = rotations.multiply(noise, exact).numpy()
    return GraphFile.from_ids(ids[source], ids[target], measured, kind=(np.abs(ids[source] - ids[target]) != 1) * 1)


@pytest.fixture
def graph_path(tmp_path: Path) -> Path:
    write_graph(tmp_path / "run.g2o", pose_graph())
    return tmp_path / "run.g2o"


def rows(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


def test_answer(graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["solve", str(graph_path), "--output", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    assert "30 nodes, 43 edges, 1 of 15 closures flagged, 1 component, " in captured.out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "edges.csv",
        "orientations.csv",
        "summary.json",
    ]

    graph_file = read_graph(graph_path)
    graph, ids = graph_file.graph, graph_file.node_ids
    solution = solve(graph)
    header, *orientations = rows(tmp_path / "out" / "orientations.csv")
    assert header == ["id", "qx", "qy", "qz", "qw", "component", "sigma_deg"]
    assert [int(row[0]) for row in orientations] == ids.tolist() == sorted(ids)
    world_from_body = torch.tensor([[float(cell) for cell in row[1:5]] for row in orientations], dtype=torch.float64)
    assert (world_from_body[:, 3] >= 0).all()
    expected = rotations.inverse(solution.body_from_world)
    assert rotations.angle_between(world_from_body, expected).max() < 1e-9
    assert [int(row[5]) for row in orientations] == solution.component.tolist()
    sigma_deg = [float(row[6]) for row in orientations]
    np.testing.assert_allclose(sigma_deg, torch.rad2deg(solution.uncertainty), atol=1e-4)

    header, *edges = rows(tmp_path / "out" / "edges.csv")
    assert header == ["source", "target", "outlier_score", "outlier"]
    ends = [[int(row[0]), int(row[1])] for row in edges]
    assert ends == np.stack((ids[graph.source], ids[graph.target]), axis=1).tolist()
    scores = np.array([float(row[2]) for row in edges])
    np.testing.assert_allclose(scores, solution.outlier_score, atol=1e-6)
    assert [int(row[3]) for row in edges] == (solution.outlier_score > 0.5).int().tolist()
    assert edges[33][3] == "1"

    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert {name: summary[name] for name in ("nodes", "edges", "components", "skipped", "profile", "version")} == {
        "nodes": 30, "edges": 43, "components": 1, "skipped": {}, "profile": "slam", "version": __version__,
    }  # fmt: skip
    assert summary["outliers"] == int((solution.outlier_score > 0.5).sum())
    assert (summary["loop_closures"], summary["flagged_closures"]) == (15, 1)
    assert summary["method"] == "neurora"
    assert summary["device"] in ("cpu", "cuda")
    assert 0 < max(summary["stage_seconds"].values()) <= summary["solve_seconds"]
    assert summary["peak_memory_bytes"] > 10_000_000


def test_warnings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Twelve closures that state the wrong way round what a quarter of a turn in thirty steps measures."""
    path, out = tmp_path / "run.g2o", tmp_path / "out"
    edge = "EDGE_SE2 {} {} 0 0 {:.9f} 1 0 0 1 0 100\n"
    odometry = "".join(edge.format(i, i + 1, np.pi / 60) for i in range(400))
    closures = [edge.format(i, i + 30, -np.pi / 2) for i in range(0, 360, 30)]
    path.write_text(odometry + "".join(closures))
    assert main(["solve", str(path), "--output", str(out)]) == 0
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    summary = json.loads((out / "summary.json").read_text())
    assert lines == [f"rotavg: warning: {path}: {text}" for text in summary["warnings"]]
    assert "0 of 12 loop closures agree" in lines[0] and "12 would with the closures' rotations inverted" in lines[0]
    assert "401 nodes" in captured.out

    path.write_text(odometry)
    assert main(["solve", str(path), "--output", str(out)]) == 0
    assert capsys.readouterr().err == ""
    assert json.loads((out / "summary.json").read_text())["warnings"] == []


def test_what_the_file_makes_doubtful_is_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = tmp_path / "degrees.g2o", tmp_path / "out"
    path.write_text("".join(f"EDGE_SE2 {i} {i + 1} 1 0 90 1 0 0 1 0 100\n" for i in range(4)))
    assert main(["solve", str(path), "--output", str(out)]) == 0
    (warning,) = json.loads((out / "summary.json").read_text())["warnings"]
    assert "angles are in radians" in warning
    assert capsys.readouterr().err == f"rotavg: warning: {path}: {warning}\n"


def test_warnings_name_nodes_by_their_ids(tmp_path: Path) -> None:
    """Two odometries between nodes 5000, 5007 …, of which one slips by 57° in the step after node 5140."""
    rng, path = np.random.default_rng(0), tmp_path / "run.npz"
    true = Rotation.from_rotvec(0.3 * rng.normal(size=(39, 3)))
    wheels, camera = (true * Rotation.from_rotvec(0.01 * rng.normal(size=(39, 3))) for _ in range(2))
    slip = Rotation.from_rotvec(np.where(np.arange(39)[:, None] == 20, [0.0, 0.0, 1.0], 0.0))
    first = 5000 + 7 * np.tile(np.arange(39), 2)
    relative = np.concatenate([wheels.as_quat(), (slip * camera).as_quat()])
    np.savez(path, source=first, target=first + 7, target_from_source=relative, kind=np.zeros(78, dtype=int))
    assert main(["solve", str(path), "--output", str(tmp_path / "out")]) == 0
    (warning,) = json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"]
    assert "(between nodes 5140 and 5147): " in warning


def test_components_lone_nodes_and_skipped_lines(tmp_path: Path) -> None:
    path = tmp_path / "two.g2o"
    edge = "EDGE_SE2 {} {} 1 0 0.1 1 0 0 1 0 100\n"
    path.write_text("VERTEX_SE2 7 0 0 0\nFIX 0\n" + edge.format(0, 1) + edge.format(3, 3) + edge.format(10, 11))
    assert main(["solve", str(path), "--output", str(tmp_path / "out")]) == 0
    orientations = rows(tmp_path / "out" / "orientations.csv")[1:]
    assert [(int(row[0]), int(row[5])) for row in orientations] == [(0, 0), (1, 0), (3, 1), (7, 2), (10, 3), (11, 3)]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["components"] == 4
    assert summary["skipped"] == {"FIX": 1, "self-edge": 1}


def test_what_was_flagged_is_told_with_what_there_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chain = pose_graph()
    is_odometry = chain.graph.is_odometry
    graphs = {
        "odometry.npz": (GraphFile(chain.graph.select_edges(is_odometry), chain.node_ids), "no closures, 2 components"),
        "sfm.npz": (GraphFile(chain.graph.select_edges(~is_odometry), chain.node_ids), " of 15 edges flagged, "),
    }
    for name, (graph_file, told) in graphs.items():
        write_graph(tmp_path / name, graph_file)
        assert main(["solve", str(tmp_path / name), "--output", str(tmp_path / "out")]) == 0
        assert told in capsys.readouterr().out


def test_edges_as_npz_or_not_at_all(graph_path: Path, tmp_path: Path) -> None:
    """Another choice of --edges replaces the older answer's edges, so that a folder holds one answer."""
    out = tmp_path / "out"
    command = ["solve", str(graph_path), "--output", str(out)]
    assert main(command) == 0
    as_csv = np.loadtxt(out / "edges.csv", delimiter=",", skiprows=1)
    assert main([*command, "--edges", "npz"]) == 0
    with np.load(out / "edges.npz") as arrays:
        together = np.stack([arrays[name] for name in ("source", "target", "outlier_score", "outlier")], axis=1)
    np.testing.assert_allclose(together, as_csv, atol=1e-6)
    assert not (out / "edges.csv").exists()
    assert main([*command, "--edges", "none"]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["orientations.csv", "summary.json"]


def test_options_reach_the_solver(graph_path: Path, tmp_path: Path) -> None:
    command = ["solve", str(graph_path), "--output", str(tmp_path / "out"), "--method", "spt", "--profile", "sfm"]
    assert main([*command, "--refine", "0", "--device", "cpu"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["method"], summary["profile"], summary["device"]) == ("spt", "sfm", "cpu")


def test_weights(graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["solve", str(graph_path), "--profile", "sfm", "--method", "cleannet-spt", "--output"]
    trained = tmp_path / "trained"
    trained.mkdir()
    assert main([*command, str(tmp_path / "none"), "--weights", str(trained)]) == 2
    assert "has no weights" in capsys.readouterr().err
    for suffix in ("safetensors", "json"):
        shutil.copy(WEIGHTS_FOLDER / f"sfm-clean-net.{suffix}", trained)
    tensors = {name: 0 * value for name, value in load_file(trained / "sfm-clean-net.safetensors").items()}
    with safe_open(trained / "sfm-clean-net.safetensors", "pt") as file:
        save_file(tensors, trained / "sfm-clean-net.safetensors", file.metadata())
    assert main([*command, str(tmp_path / "ours"), "--weights", str(trained)]) == 0
    # A network of zeros gives every edge the log-odds 0.
    assert {float(row[2]) for row in rows(tmp_path / "ours" / "edges.csv")[1:]} == {0.5}


def test_several_graphs(graph_path: Path, tmp_path: Path) -> None:
    write_graph(tmp_path / "other.npz", pose_graph(40, seed=1))
    write_graph(tmp_path / "EGs.txt", pose_graph(20, seed=2))
    graphs = [str(graph_path), str(tmp_path / "other.npz"), str(tmp_path / "EGs.txt")]
    assert main(["solve", *graphs, "--output", str(tmp_path / "out")]) == 0
    for stem, nodes, profile in (("run", 30, "slam"), ("other", 40, "slam"), ("EGs", 20, "sfm")):
        summary = json.loads((tmp_path / "out" / stem / "summary.json").read_text())
        assert (summary["nodes"], summary["profile"]) == (nodes, profile)


def test_the_plan_looks_at_every_graph_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked, realpath = [], os.path.realpath
    monkeypatch.setattr(os.path, "realpath", lambda path, **given: looked.append(path) or realpath(path, **given))
    counts = []
    for number in (10, 20):
        looked.clear()
        plan([tmp_path / f"{index}.g2o" for index in range(number)], tmp_path / "out", "csv")
        counts.append(len(looked))
    assert counts[1] == 2 * counts[0]


def test_a_gpu_is_of_no_use_to_a_robots_graph(
    graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for device, is_told in (("cuda", True), ("cpu", False)):
        assert main(["solve", str(graph_path), "--output", str(tmp_path / "out"), "--device", device]) == 0
        assert ("--device cuda has no effect" in capsys.readouterr().err) == is_told


@pytest.mark.parametrize(
    ("name", "options"), [("edges.csv", []), ("summary.json", []), ("edges.npz", ["--edges", "npz"])]
)
def test_what_no_answer_has_written_is_not_overwritten(
    graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, options: list[str]
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("somebody's own")
    assert main(["solve", str(graph_path), "--output", str(out), *options]) == 2
    assert f"{name} would be overwritten, though no earlier answer" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == [name] and (out / name).read_text() == "somebody's own"
    (out / name).unlink()
    for _ in range(2):
        assert main(["solve", str(graph_path), "--output", str(out), *options]) == 0


@pytest.mark.parametrize("listed", ["[]", "null", '{"files": "summary.json"}', '{"files": [{"name": "edges.csv"}]}'])
def test_a_summary_of_another_program_lists_nothing(
    graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], listed: str
) -> None:
    (tmp_path / "summary.json").write_text(listed)
    assert main(["solve", str(graph_path), "--output", str(tmp_path)]) == 2
    assert "summary.json would be overwritten" in capsys.readouterr().err


def test_others_files_beside_an_answer_stay(graph_path: Path, tmp_path: Path) -> None:
    """Edges of an older answer in another format go, somebody's own do not."""
    out = tmp_path / "out"
    assert main(["solve", str(graph_path), "--output", str(out), "--edges", "npz"]) == 0
    assert main(["solve", str(graph_path), "--output", str(out), "--edges", "none"]) == 0
    assert not (out / "edges.npz").exists()
    (out / "edges.npz").write_text("somebody's own")
    (out / "summary.json").write_text('{"files": [{}, "summary.json", "orientations.csv"]}')
    assert main(["solve", str(graph_path), "--output", str(out)]) == 0
    assert (out / "edges.npz").read_text() == "somebody's own"


def test_installed_command(graph_path: Path, tmp_path: Path) -> None:
    """As a process, from another folder; nothing but the summary on stdout, nothing on stderr."""
    command = [sys.executable, "-m", "rotavg_ros.cli.main", "solve", str(graph_path), "--output", "out"]
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert len(result.stdout.splitlines()) == 1
    assert (tmp_path / "out" / "orientations.csv").exists()


@pytest.mark.large
@pytest.mark.parametrize("name", ["sphere2500", "manhattan"])
def test_clean_graphs_come_close_to_the_truth(shared_data: Path, tmp_path: Path, name: str) -> None:
    assert main(["solve", str(shared_data / "slam" / f"{name}.g2o"), "--output", str(tmp_path)]) == 0
    estimate, truth = (
        torch.from_numpy(np.loadtxt(path, delimiter=",", skiprows=1, usecols=(1, 2, 3, 4)))
        for path in (tmp_path / "orientations.csv", shared_data / "slam" / f"{name}_ground_truth.csv")
    )
    # Both start at the identity, up to the truth's own first orientation.
    offset = rotations.multiply(rotations.normalize(truth[:1]), rotations.inverse(estimate[:1]))
    error = rotations.angle_between(rotations.multiply(offset, estimate), rotations.normalize(truth))
    assert error.rad2deg().mean() < 6


def test_parts_of_the_posterior_can_be_switched_off(
    graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["solve", str(graph_path), "--output", str(tmp_path / "out"), "--without", "slips", "cleannet"]
    assert main(command) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["method"] == "neurora~slips,cleannet"
    assert main([*command, "--method", "cleannet-spt"]) == 2
    assert "--without leaves out parts of --method neurora, not of cleannet-spt; leave" in capsys.readouterr().err
    assert main([*command, "--method", "neurorra"]) == 2
    assert "unknown method 'neurorra'; choose from" in capsys.readouterr().err
