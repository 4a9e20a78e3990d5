"""What the options offer is what there is."""

from __future__ import annotations

from rotavg_ros.cli import evaluate_slam
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.worlds import ROBOT_WORLDS
from rotavg_ros.evaluation import names
from rotavg_ros.evaluation.benchmark.measure import LABELS
from rotavg_ros.evaluation.benchmark.plans import FAMILIES
from rotavg_ros.evaluation.sfm import robustness, synthetic
from rotavg_ros.evaluation.slam import cases


def test_names_are_those_of_what_runs() -> None:
    assert tuple(synthetic.RECIPES) == names.SYNTHETIC_RECIPES
    assert tuple(robustness.SETTINGS) == names.ROBUSTNESS_SETTINGS
    assert cases.GRAPHS == names.SLAM_GRAPHS
    assert tuple(evaluate_slam.SUITES) == names.SLAM_SUITES
    assert tuple(FAMILIES) == names.BENCHMARK_FAMILIES
    assert tuple(LABELS) == names.BENCHMARK_CONTENDERS


def test_a_robot_can_drive_in_every_world_offered() -> None:
    assert [RobotRun(world).config().world for world in ROBOT_WORLDS] == list(ROBOT_WORLDS)
