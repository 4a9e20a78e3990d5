"""A simulated run as a bag, and its replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph

# Few ticks: their number is not what these tests are about.
SELDOM = ["-p", "solve_period_s:=40.0"]


@pytest.fixture(scope="session")
def run() -> SimulatedRun:
    """Two laps of a building, three closures in ten false."""
    return simulate_slam_graph(RobotRun(laps=2).config(), np.random.default_rng(2))


@pytest.fixture(scope="session")
def bag(run: SimulatedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "building"
    write_run_bag(folder, run)
    return folder


@pytest.fixture(scope="session")
def replayed(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a whole replay, report included."""
    output = tmp_path_factory.mktemp("replays") / "building"
    assert main(["replay", str(bag), "--output", str(output), *SELDOM]) == 0
    return output
