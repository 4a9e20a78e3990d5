"""A replay's files, read by those whom they are for: evo, gtsam, the mcap library, rosbags."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation, StatisticsType
from evo.core.sync import associate_trajectories
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from rotavg_ros.bags.graph_to_bag import write_graph_bag
from rotavg_ros.bags.reader import BagReader
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun
from rotavg_ros.settings.parameters import PARAMETERS

from .conftest import SELDOM

EVERYTHING = {
    "/abs_orientations": "rotavg_msgs/msg/AbsoluteOrientations",
    "/outlier_flags": "rotavg_msgs/msg/OutlierFlags",
    "/orientation": "geometry_msgs/msg/QuaternionStamped",
    "/corrected_path": "nav_msgs/msg/Path",
    "/rotavg/markers": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


def read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def truth_of(run: SimulatedRun) -> PoseTrajectory3D:
    wxyz = np.roll(run.world_from_body, 1, axis=1)
    return PoseTrajectory3D(run.position, wxyz, run.stamps_ns / 1e9)


def ape(truth: PoseTrajectory3D, path: Path) -> float:
    """Root mean square of the position error after alignment, by evo."""
    truth, estimate = associate_trajectories(truth, file_interface.read_tum_trajectory_file(str(path)), max_diff=0.01)
    estimate.align(truth)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((truth, estimate))
    return metric.get_statistic(StatisticsType.rmse)


def test_trajectories_load_in_evo_and_are_nearer_to_the_truth(run: SimulatedRun, replayed: Path) -> None:
    before, after = ape(truth_of(run), replayed / "odometry.tum"), ape(truth_of(run), replayed / "trajectory.tum")
    assert after < 0.5 * before
    said = json.loads((replayed / "summary.json").read_text())["robots"]["robot"]
    assert said["reference"] == "/ground_truth"
    assert said["position_error_rms_m"]["odometry"] == pytest.approx(before, rel=1e-3)
    assert said["position_error_rms_m"]["corrected"] == pytest.approx(after, rel=1e-3)
    tum = file_interface.read_tum_trajectory_file(str(replayed / "trajectory.tum"))
    kitti = file_interface.read_kitti_poses_file(str(replayed / "trajectory.kitti"))
    np.testing.assert_allclose(kitti.poses_se3, tum.poses_se3, atol=1e-8)


def test_stamps_are_exact(run: SimulatedRun, replayed: Path) -> None:
    words = [line.split()[0] for line in (replayed / "trajectory.tum").read_text().splitlines()]
    stamps = [int(word.replace(".", "")) for word in words]
    assert set(stamps) <= set(run.stamps_ns.tolist())
    assert stamps == sorted(set(stamps))


def test_the_graph_loads_in_gtsam_and_is_near_its_own_least_squares(run: SimulatedRun, replayed: Path) -> None:
    """Corrected vertices, no outliers: gtsam's optimum of what is left moves nobody far."""
    factors, values = gtsam.readG2o(str(replayed / "graph.g2o"), False)
    assert values.size() == len(read_csv(replayed / "orientations.csv")["id"])
    edges = read_csv(replayed / "edges.csv")
    assert factors.size() == int((edges["outlier"] == 0).sum())
    factors.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)))
    optimum = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    keys = range(values.size())
    moved = [np.hypot(*(optimum.atPose2(key).translation() - values.atPose2(key).translation())) for key in keys]
    turned = [abs(optimum.atPose2(key).rotation().between(values.atPose2(key).rotation()).theta()) for key in keys]
    assert np.sqrt(np.mean(np.square(moved))) < 0.5
    assert np.degrees(np.mean(turned)) < 2


def test_tables_are_like_those_of_solve(run: SimulatedRun, replayed: Path) -> None:
    orientations, edges = read_csv(replayed / "orientations.csv"), read_csv(replayed / "edges.csv")
    assert list(orientations) == ["id", "qx", "qy", "qz", "qw", "component", "sigma_deg"]
    judged = ["rotation_score", "residual_deg", "residual_m"]
    assert list(edges) == ["source", "target", "outlier_score", "outlier", *judged, "edge_id"]
    with BagReader(replayed / "run.mcap") as recording:
        *_, (_, _, flags) = recording.decoded(["/outlier_flags"])
    np.testing.assert_array_equal(edges["edge_id"], flags.edge_ids.astype(float))
    np.testing.assert_allclose(edges["residual_deg"], flags.residuals_deg, atol=1e-4)
    np.testing.assert_allclose(edges["residual_m"], flags.residuals_m, atol=1e-4)
    np.testing.assert_allclose(edges["rotation_score"], flags.rotation_scores, atol=1e-6)
    summary = json.loads((replayed / "summary.json").read_text())
    assert summary["warnings"] == []
    assert len(orientations["id"]) == summary["keyframes"]
    assert (np.diff(orientations["id"]) == 1).all()
    assert summary["edges"] == len(edges["source"])
    assert summary["outliers"] == edges["outlier"].sum()
    assert summary["loop_closures"] == int((~run.graph.is_odometry).sum())
    assert summary["flagged_closures"] == summary["outliers"]  # no odometry slips
    assert abs(summary["outliers"] - run.closure_is_false.sum()) <= 2
    assert sorted(summary["files"]) == sorted(path.name for path in replayed.iterdir())
    assert {"report.html", "trajectory.png", "run.mcap"} <= set(summary["files"])
    assert not summary["interrupted"]


def test_the_parameters_are_told_as_users_write_them(replayed: Path) -> None:
    options = json.loads((replayed / "summary.json").read_text())["options"]
    assert list(options) == list(PARAMETERS)
    expected = {"keyframe_angle_deg": 5.0, "solve_period_s": 40.0, "odometry_topics": ["/odom:nav_msgs/msg/Odometry"]}
    assert {name: options[name] for name in expected} == expected
    page = (replayed / "report.html").read_text()
    rows = re.findall(r'<td class="code">(\w+)</td>\s*<td class="code">([^<]*)</td>', page)
    assert [name for name, _ in rows if name in PARAMETERS] == list(PARAMETERS)
    assert {("keyframe_angle_deg", "5"), ("solve_period_s", "40"), ("warm_start", "True")} <= set(rows)


def test_the_recording_is_what_a_node_would_have_published(run: SimulatedRun, bag: Path, replayed: Path) -> None:
    """Every topic with its schema; log times inside the bag's; an orientation per odometry message; answers latched."""
    stamps, seen = run.stamps_ns, dict.fromkeys(EVERYTHING, 0)
    with (replayed / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert {channel.topic for channel in summary.channels.values()} == set(EVERYTHING)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.name, schema.encoding) == (EVERYTHING[channel.topic], "ros2msg")
            assert channel.message_encoding == "cdr"
            assert stamps[0] <= message.log_time <= stamps[-1]
            seen[channel.topic] += 1
        durability = {channel.topic: channel.metadata["offered_qos_profiles"] for channel in summary.channels.values()}
    assert "durability: 1" in durability["/abs_orientations"]
    assert "durability: 2" in durability["/orientation"]
    assert seen["/orientation"] == len(stamps)
    assert seen["/abs_orientations"] == seen["/outlier_flags"] == seen["/corrected_path"] == seen["/rotavg/markers"] > 5
    assert seen["/diagnostics"] == pytest.approx((stamps[-1] - stamps[0]) / 1e9, abs=2)


def test_the_last_recorded_answer_is_the_one_in_the_tables(replayed: Path) -> None:
    orientations, edges = read_csv(replayed / "orientations.csv"), read_csv(replayed / "edges.csv")
    with AnyReader([replayed / "run.mcap"]) as reader:
        newest = {connection.topic: (data, connection.msgtype) for connection, _, data in reader.messages()}
        last = {topic: reader.deserialize(*serialised) for topic, serialised in newest.items()}
    table = np.stack([orientations[f"q{axis}"] for axis in "xyzw"], axis=1)
    np.testing.assert_allclose(last["/abs_orientations"].orientations.reshape(-1, 4), table, atol=1e-9)
    np.testing.assert_array_equal(last["/outlier_flags"].outliers, edges["outlier"] == 1)
    np.testing.assert_allclose(last["/outlier_flags"].scores, edges["outlier_score"], atol=1e-6)
    tum = np.loadtxt(replayed / "trajectory.tum")
    path = [pose.pose.position for pose in last["/corrected_path"].poses]
    np.testing.assert_allclose([[point.x, point.y, point.z] for point in path], tum[:, 1:4], atol=1e-6)


def test_a_reference_of_orientations_alone_judges_no_positions(run: SimulatedRun, tmp_path: Path) -> None:
    """A pose message cannot say that its position is unknown: such references stay at the origin."""
    write_graph_bag(tmp_path / "bag", replace(run.to_graph_file(), position_gt=None))
    assert main(["replay", str(tmp_path / "bag"), "--output", str(tmp_path / "out"), "--no-report", *SELDOM]) == 0
    (robot,) = json.loads((tmp_path / "out" / "summary.json").read_text())["robots"].values()
    assert robot["orientation_error_mean_deg"]["corrected"] < 5
    assert "position_error_rms_m" not in robot
