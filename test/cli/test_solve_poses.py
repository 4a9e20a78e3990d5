"""`rotavg solve --poses`: positions as well, for evo and gtsam."""

from __future__ import annotations

import copy
from pathlib import Path

import gtsam
import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.trajectory import PosePath3D
from evo.tools import file_interface

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_solved_file_with_positions(tmp_path: Path, dimensions: int) -> None:
    world = World.CITY if dimensions == 2 else World.SPHERE
    config = SlamSimulationConfig(world=world, dimensions=dimensions, num_keyframes=400, false_share=0.3)
    run = simulate_slam_graph(config, np.random.default_rng(3))
    write_graph(tmp_path / "run.npz", run.to_graph_file())
    assert main(["solve", str(tmp_path / "run.npz"), "--output", str(tmp_path / "out"), "--poses"]) == 0

    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "out" / "trajectory.tum"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "out" / "trajectory.kitti"))
    np.testing.assert_allclose(tum.positions_xyz, kitti.positions_xyz, atol=1e-8)
    np.testing.assert_allclose(tum.timestamps, run.stamps_ns / 1e9, atol=1e-6)
    truth = PosePath3D(run.position, np.roll(run.world_from_body, 1, axis=1))
    odometry = PosePath3D(run.odometry_position, np.roll(run.odometry_world_from_body, 1, axis=1))
    assert error(kitti, truth) < 0.5 * error(odometry, truth)

    factors, values = gtsam.readG2o(str(tmp_path / "out" / "graph.g2o"), dimensions == 3)
    assert values.size() == 400
    assert factors.size() <= run.graph.num_edges - 0.9 * run.closure_is_false.sum()  # outliers are left out
    where = [
        values.atPose2(k).translation() if dimensions == 2 else values.atPose3(k).translation() for k in range(400)
    ]
    np.testing.assert_allclose(where, kitti.positions_xyz[:, :dimensions], atol=1e-6)


def test_a_graph_is_not_overwritten_by_its_own_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=100), np.random.default_rng(0))
    write_graph(tmp_path / "graph.g2o", run.to_graph_file())
    assert main(["solve", str(tmp_path / "graph.g2o"), "--output", str(tmp_path), "--poses"]) == 2
    assert "would be overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("end", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_an_answer_takes_an_older_ones_place_as_a_whole(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    end: type[BaseException] | OSError,
) -> None:
    for seed in (0, 1):
        run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=100), np.random.default_rng(seed))
        write_graph(tmp_path / f"{seed}.npz", run.to_graph_file())
    out = tmp_path / "out"
    assert main(["solve", str(tmp_path / "0.npz"), "--poses", "--output", str(out)]) == 0
    older = {path.name: path.read_bytes() for path in out.iterdir()}

    def write_rows(*_: object) -> None:
        raise end

    monkeypatch.setattr("rotavg_ros.datasets.files.pose_files.write_rows", write_rows)
    words = ["solve", str(tmp_path / "1.npz"), "--poses", "--output", str(out)]
    assert main(words) == (2 if isinstance(end, OSError) else 130)
    if isinstance(end, OSError):
        assert f"{out}/trajectory.kitti: cannot be written: No space left" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == older


def test_an_older_answers_poses_go_and_others_graphs_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=100), np.random.default_rng(0))
    write_graph(tmp_path / "run.npz", run.to_graph_file())
    write_graph(tmp_path / "run.g2o", run.to_graph_file())  # without stamps
    out = tmp_path / "out"
    out.mkdir()
    (out / "graph.g2o").write_text("somebody's own")
    assert main(["solve", str(tmp_path / "run.g2o"), "--output", str(out)]) == 0
    assert main(["solve", str(tmp_path / "run.g2o"), "--poses", "--output", str(out)]) == 2
    assert "graph.g2o would be overwritten" in capsys.readouterr().err
    assert (out / "graph.g2o").read_text() == "somebody's own"
    (out / "graph.g2o").unlink()
    for words, names in (
        (["run.g2o"], set()),
        (["run.npz", "--poses"], {"graph.g2o", "trajectory.kitti", "trajectory.tum"}),
        (["run.g2o", "--poses"], {"graph.g2o", "trajectory.kitti"}),
        (["run.npz"], set()),
    ):
        assert main(["solve", str(tmp_path / words[0]), *words[1:], "--output", str(out)]) == 0
        assert {path.name for path in out.iterdir()} - {"orientations.csv", "edges.csv", "summary.json"} == names
    assert main(["solve", str(tmp_path / "run.g2o"), "--poses", "--output", str(out)]) == 0
    capsys.readouterr()
    assert main(["solve", str(out / "graph.g2o"), "--output", str(out)]) == 2
    assert "graph.g2o would be overwritten" in capsys.readouterr().err
    assert (out / "graph.g2o").exists()


def error(estimate: PosePath3D, truth: PosePath3D) -> float:
    """Root mean square of the position error after alignment, by evo."""
    estimate = copy.deepcopy(estimate)
    estimate.align(truth)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((truth, estimate))
    return float(metric.get_statistic(StatisticsType.rmse))
