"""Simulate a robot on several laps of a building or of city streets and write the bag it would have recorded.

The bag (rosbag2, MCAP) has, at 10 Hz, /odom (drifting) and /ground_truth, and loop closures by stamp on
/relative_rotations, a chosen share of them false. Play it with `rotavg play`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.bags.writer import refuse_existing
from rotavg_ros.cli.arguments import finite_number, non_negative_number, positive_number, share, whole_number
from rotavg_ros.cli.progress import working
from rotavg_ros.datasets.files.graph_file import write_graph
from rotavg_ros.datasets.simulation.robot_run import ROBOT_WORLDS, RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg simulate``."""
    parser.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an older bag")
    parser.add_argument("--graph", type=Path, metavar="FILE", help="also write the pose graph (.g2o, .npz)")
    add_run_arguments(parser)


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """What the run is like; shared with ``rotavg demo``."""
    parser.add_argument("--world", choices=ROBOT_WORLDS, default="building", help="default: building")
    parser.add_argument(
        "--dimensions", type=int, choices=(2, 3), default=2, help="3: ramps and uneven ground (default: 2)"
    )
    parser.add_argument(
        "--laps", type=positive_number, default=4, metavar="N", help="visits of every place, about (default: 4)"
    )
    parser.add_argument(
        "--false-share", type=share, default=0.3, metavar="SHARE", help="of the closures (default: 0.3)"
    )
    parser.add_argument("--grouped", action="store_true", help="false closures in groups that agree with each other")
    parser.add_argument(
        "--closures-per-minute", type=non_negative_number, default=20, metavar="N", help="good and false (default: 20)"
    )
    parser.add_argument(
        "--closure-noise-deg", type=non_negative_number, default=1.0, metavar="DEG", help="RMS angle (default: 1)"
    )
    parser.add_argument(
        "--odometry-noise-deg",
        type=non_negative_number,
        default=0.1,
        metavar="DEG",
        help="RMS angle every 0.1 s (default: 0.1)",
    )
    parser.add_argument(
        "--odometry-bias-deg-per-min",
        type=finite_number,
        default=2.0,
        metavar="DEG",
        help="gyroscope bias (default: 2)",
    )
    parser.add_argument("--seed", type=whole_number, default=0, metavar="S", help="same seed, same run (default: 0)")


def simulate(arguments: argparse.Namespace) -> SimulatedRun:
    """The run that the arguments of :func:`add_run_arguments` describe."""
    config = RobotRun(
        arguments.world,
        dimensions=arguments.dimensions,
        laps=arguments.laps,
        false_share=arguments.false_share,
        grouped=arguments.grouped,
        closures_per_minute=arguments.closures_per_minute,
        odometry_noise_deg=arguments.odometry_noise_deg,
        odometry_bias_deg_per_min=arguments.odometry_bias_deg_per_min,
        closure_noise_deg=arguments.closure_noise_deg,
    ).config()
    return simulate_slam_graph(config, np.random.default_rng(arguments.seed))


def run(arguments: argparse.Namespace) -> int:
    """Simulate and write."""
    refuse_existing(arguments.output, overwrite=arguments.overwrite)
    with working("simulating"):
        simulated = simulate(arguments)
        # First what is likelier to fail, so that no bag lies there of a command that did not work.
        if arguments.graph is not None:
            write_graph(arguments.graph, simulated.to_graph_file())
        write_run_bag(arguments.output, simulated, overwrite=arguments.overwrite)
    print(f"{arguments.output}: {describe(simulated)}")
    return 0


def describe(simulated: SimulatedRun) -> str:
    """The run in a line."""
    duration_s = (simulated.stamps_ns[-1] - simulated.stamps_ns[0]) / 1e9
    distance_m = np.linalg.norm(np.diff(simulated.position, axis=0), axis=1).sum()
    closures = int((~simulated.graph.is_odometry).sum())
    return (
        f"{duration_s:.0f} s, {distance_m:.0f} m, {len(simulated.stamps_ns)} odometry messages, "
        f"{closures} loop closures, {int(simulated.closure_is_false.sum())} of them false"
    )
