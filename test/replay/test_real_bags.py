"""Real robots' bags without a word of explanation, and a real graph as a bag."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rotavg_ros.cli.main import main

FEW_TICKS = ["--no-report", "--answers", "2", "-p", "solve_period_s:=1000.0"]


@pytest.mark.parametrize(
    ("name", "odometry", "reference"),
    [
        ("husky_test1.bag", "/husky_velocity_controller/odom", "/imu/data (mounting fitted)"),
        ("nav2_turtlebot.mcap", "/odom", "/amcl_pose"),
    ],
)
def test_a_recorded_robot(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, odometry: str, reference: str
) -> None:
    output = tmp_path / "out"
    assert main(["replay", str(shared_data / "bags" / name), "--output", str(output), *FEW_TICKS]) == 0
    assert "no loop closures in this bag" in capsys.readouterr().out
    summary = json.loads((output / "summary.json").read_text())
    assert summary["topics"][odometry] == "odometry of robot"
    robot = summary["robots"]["robot"]
    assert robot["reference"] == reference
    assert robot["keyframes"] > 100
    # An IMU that is mounted askew would be off by a right angle; wheels that slip are off by less.
    assert robot["orientation_error_mean_deg"]["corrected"] < 20
    assert summary["rejected"] == {}


@pytest.mark.large
def test_b25b_from_graph_to_positions(shared_data: Path, tmp_path: Path) -> None:
    graph = shared_data / "slam" / "b25b" / "B25b_0.500.g2o"
    companions = ["--stamps", str(graph.with_name("B25b_timestamps.txt"))]
    companions += ["--truth", str(graph.with_name("ground_truth.csv"))]
    assert main(["convert", str(graph), str(tmp_path / "bag"), *companions]) == 0
    assert main(["replay", str(tmp_path / "bag"), "--output", str(tmp_path / "out"), *FEW_TICKS]) == 0
    robot = json.loads((tmp_path / "out" / "summary.json").read_text())["robots"]["robot"]
    degrees, metres = robot["orientation_error_mean_deg"], robot["position_error_rms_m"]
    assert degrees["corrected"] < 1.8 < 3.5 < degrees["odometry"]
    assert max(metres["corrected"], metres["dead_reckoned"]) < 1.6 < metres["odometry"]
