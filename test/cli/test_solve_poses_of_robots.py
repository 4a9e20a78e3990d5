"""What `rotavg solve --poses` writes where translations are known: plain least squares can go on from it."""

from __future__ import annotations

import csv
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import read_graph, write_graph
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.metrics.positions import position_errors

# Beyond and below these a closure's place is wrong or right, whatever the ground truth's own error; metres, degrees.
WRONG_METRES, RIGHT_METRES, WRONG_DEG, RIGHT_DEG = 4.0, 1.5, 10.0, 8.0


def rms(position: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(position_errors(position, truth) ** 2)))


def least_squares(path: Path, from_odometry: bool) -> tuple[np.ndarray, np.ndarray]:
    """Positions ``(N, 3)`` of the vertices, and of gtsam's Levenberg–Marquardt on the file."""
    gtsam = pytest.importorskip("gtsam")
    factors, vertices = gtsam.readG2o(str(path), False)
    keys = sorted(vertices.keys())
    start = gtsam.Values(vertices)
    if from_odometry:
        pose = vertices.atPose2(keys[0])
        steps = {tuple(f.keys()): f.measured() for f in map(factors.at, range(factors.size()))}
        for first, second in itertools.pairwise(keys):
            pose = pose.compose(steps[first, second])
            start.update(second, pose)
    factors.add(gtsam.PriorFactorPose2(keys[0], start.atPose2(keys[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    found = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()

    def positions(values: object) -> np.ndarray:
        return np.array([[*values.atPose2(key).translation(), 0.0] for key in keys])

    return positions(vertices), positions(found)


@pytest.mark.parametrize("seed", range(3))
def test_least_squares_stays_where_it_is_put(tmp_path: Path, seed: int) -> None:
    config = SlamSimulationConfig(num_keyframes=400, laps=3.0, closures_per_keyframe=0.15, false_share=0.3)
    run = simulate_slam_graph(config, np.random.default_rng(seed))
    write_graph(tmp_path / "run.g2o", run.to_graph_file())
    assert main(["solve", str(tmp_path / "run.g2o"), "--output", str(tmp_path / "out"), "--poses"]) == 0
    for from_odometry in (False, True):
        vertices, found = least_squares(tmp_path / "out" / "graph.g2o", from_odometry)
        assert rms(found, run.position) <= 1.02 * rms(vertices, run.position) + 0.01


def test_translations_that_are_no_metres_judge_no_closure(tmp_path: Path) -> None:
    config = SlamSimulationConfig(num_keyframes=200, laps=3.0, closures_per_keyframe=0.15)
    run = simulate_slam_graph(config, np.random.default_rng(0))
    write_graph(tmp_path / "run.g2o", run.to_graph_file())
    columns = {}
    for scale in ("metric", "none"):
        out = tmp_path / scale
        command = ["solve", str(tmp_path / "run.g2o"), "--output", str(out), "--poses", "--translation-scale", scale]
        assert main(command) == 0
        columns[scale] = set(_rows(out / "edges.csv")[0])
        assert (out / "trajectory.kitti").stat().st_size > 0
    assert columns["metric"] - columns["none"] == {"rotation_score", "residual_deg", "residual_m"}


@pytest.mark.parametrize(
    ("threshold", "metres", "degrees"),
    [
        pytest.param(*given, marks=pytest.mark.large)
        for given in (("0.000", 1.0, 1.5), ("0.250", 1.1, 1.7), ("0.500", 1.15, 1.9))
    ],
)
def test_a_real_robot(shared_data: Path, tmp_path: Path, threshold: str, metres: float, degrees: float) -> None:
    """B25b: orientations, positions, and closures of right rotation that join wrong places."""
    graph = shared_data / "slam" / "b25b" / f"B25b_{threshold}.g2o"
    assert main(["solve", str(graph), "--output", str(tmp_path), "--poses"]) == 0
    stamped = attach_stamps(read_graph(graph), graph.with_name("B25b_timestamps.txt"))
    truth = attach_truth(stamped, graph.with_name("ground_truth.csv"))
    assert truth.body_from_world_gt is not None and truth.position_gt is not None
    known = np.isfinite(truth.body_from_world_gt).all(axis=1) & np.isfinite(truth.position_gt).all(axis=1)
    rows = np.array([[float(row[f"q{axis}"]) for axis in "xyzw"] for row in _rows(tmp_path / "orientations.csv")])
    world_from_body = Rotation.from_quat(truth.body_from_world_gt[known]).inv()
    off = world_from_body.inv() * Rotation.from_quat(rows[known])
    assert np.degrees((off.mean().inv() * off).magnitude().mean()) < degrees
    for from_odometry in (False, True):
        vertices, found = least_squares(tmp_path / "graph.g2o", from_odometry)
        assert rms(vertices, truth.position_gt) < metres
        assert rms(found, truth.position_gt) <= 1.02 * rms(vertices, truth.position_gt)

    wrong, right = _places(truth, known)
    flagged = np.array([row["outlier"] == "1" for row in _rows(tmp_path / "edges.csv")])
    if wrong.any():
        assert flagged[wrong].mean() >= 0.95
        assert wrong[flagged & (wrong | right)].mean() >= 0.97
    else:
        assert not flagged[right].any()


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _places(truth: object, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(M,)`` bool each: closures that are false, and right, by ground truth."""
    graph = truth.graph
    source, target = graph.source.numpy(), graph.target.numpy()
    judged = known[source] & known[target] & ~graph.is_odometry.numpy()
    edges = np.flatnonzero(judged)
    world_from_body = Rotation.from_quat(np.where(known[:, None], truth.body_from_world_gt, [0, 0, 0, 1])).inv()
    start, end = world_from_body[source[edges]], world_from_body[target[edges]]
    apart = start.inv().apply(truth.position_gt[target[edges]] - truth.position_gt[source[edges]])
    metres = np.linalg.norm(apart - truth.edge_translation[edges], axis=1)
    measured = Rotation.from_quat(graph.target_from_source.numpy()[edges])
    degrees = np.degrees((measured * (end.inv() * start).inv()).magnitude())
    wrong, right = np.zeros(len(source), dtype=bool), np.zeros(len(source), dtype=bool)
    wrong[edges] = (metres > WRONG_METRES) | (degrees > WRONG_DEG)
    right[edges] = (metres < RIGHT_METRES) & (degrees < RIGHT_DEG)
    return wrong, right
