"""What ``rotavg simulate`` does: a run and its bag; also the simulation of ``rotavg demo``."""

from __future__ import annotations

import argparse

import numpy as np

from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.bags.writer import BagWriteError, refuse_existing
from rotavg_ros.cli.progress import working
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph
from rotavg_ros.errors import asking_about
from rotavg_ros.whole_file import real


def simulate(arguments: argparse.Namespace) -> SimulatedRun:
    """The run that the arguments of :func:`rotavg_ros.cli.options.simulate.add_run_arguments` describe."""
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
    if arguments.graph is not None:
        _check_graph(arguments)
    with working("simulating"):
        simulated = simulate(arguments)
        # First the step that is more likely to fail, so that a failed command leaves no bag behind.
        if arguments.graph is not None:
            write_graph(arguments.graph, simulated.to_graph_file())
        write_run_bag(arguments.output, simulated, overwrite=arguments.overwrite)
    print(f"{arguments.output}: {describe(simulated)}")
    return 0


def _check_graph(arguments: argparse.Namespace) -> None:
    with asking_about(arguments.graph, BagWriteError):
        exists = arguments.graph.exists()
    if real(arguments.output) == real(arguments.graph):
        raise BagWriteError(f"{arguments.graph}: is the bag's place as well; choose another --graph")
    if real(arguments.output) in real(arguments.graph).parents:
        raise BagWriteError(f"{arguments.graph}: is in the bag, which is written after it; choose another --graph")
    if exists and not arguments.overwrite:
        raise BagWriteError(f"{arguments.graph}: exists already; choose another --graph or give --overwrite")


def describe(simulated: SimulatedRun) -> str:
    """The run in a line."""
    duration_s = (simulated.stamps_ns[-1] - simulated.stamps_ns[0]) / 1e9
    distance_m = np.linalg.norm(np.diff(simulated.position, axis=0), axis=1).sum()
    closures = int((~simulated.graph.is_odometry).sum())
    return (
        f"{duration_s:.0f} s, {distance_m:.0f} m, {len(simulated.stamps_ns)} odometry messages, "
        f"{closures} loop closures, {int(simulated.closure_is_false.sum())} of them false"
    )
