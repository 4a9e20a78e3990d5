"""The suite of poses: graphs whose true poses are known, and closures that join wrong places."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.files.ground_truth import attach_truth
from rotavg_ros.datasets.simulation.poses import false_places
from rotavg_ros.datasets.simulation.poses.drawn import DrawnPoses, Noise, Poses, redrawn
from rotavg_ros.datasets.simulation.poses.odometry_jumps import with_jumps
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.stress.conditions import WORLDS
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.cases import SLAM, Case, CaseKey, Kind, PoseTruth
from rotavg_ros.evaluation.slam import cases
from rotavg_ros.rotations import inverse
from rotavg_ros.solver.positions import Translations, fit_positions
from rotavg_ros.view_graph import ViewGraph

REPORTING_SEEDS = range(1000, 1003)
# Errors of orientations below this count as this.
_FLOOR = float(np.radians(0.1))
# Keeps these random numbers separate from all others.
_STREAM = 0x905E5
_SHARE = 0.3

AS_RECORDED = cases.AS_RECORDED
CLEAN = "no false closures"
# Odometry whose position jumps so often, too.
JUMPS, _NUM_JUMPS = "2 jumps of position, 30 % random", 2
CONDITIONS: dict[str, false_places.Add | None] = {
    CLEAN: None,
    "30 % random": false_places.random_places,
    "30 % parallel corridors": false_places.parallel_corridors,
    "30 % parallel corridors in runs": false_places.parallel_corridors_in_runs,
    "30 % symmetric building": false_places.symmetric_building,
    JUMPS: false_places.random_places,
}


class PoseSuiteError(UserError):
    """No kind has such a name; the message lists some that exist."""


# What classic graphs' edges are drawn with: deviations per component, rounded, that the recorded edges leave against
# the reference. Of a step of odometry from the sums of 100 steps' residuals, since least squares spreads a misfit over
# all steps between two closures; of closures from their own, over the share of them that the fit leaves.
CLASSIC_NOISE = {
    "intel": Noise(0.1, 0.01, 0.2, 0.03),
    "CSAIL": Noise(0.15, 0.006, 0.3, 0.04),
    "FR079": Noise(0.2, 0.005, 0.25, 0.03),
    "manhattan": Noise(1.1, 0.025, 1.5, 0.06),
    "sphere2500": Noise(1.4, 0.2, 1.4, 0.2),
    "parking-garage": Noise(0.03, 0.016, 0.03, 0.02),
}
# B25b's against ground truth, the only figures that are no truth but estimates: what the oracle and those who are told
# true deviations are told. Root mean square of the closures within 8° and 1.5 m, each threshold's own, since the looser
# one lets in rougher ones; and of the sums of 100 steps' residuals.
RECORDED_NOISE = {
    "B25b_0.000": Noise(0.18, 0.015, 2.4, 0.31),
    "B25b_0.250": Noise(0.18, 0.015, 2.3, 0.29),
    "B25b_0.500": Noise(0.18, 0.015, 1.8, 0.18),
}


class _Building(NamedTuple):
    """A run through a simulated world, and the noise of its edges."""

    config: SlamSimulationConfig
    noise: Noise


_USUAL_NOISE = Noise(0.5, 0.01, 1.0, 0.05)
SIMULATED = {
    "building": _Building(WORLDS["building"], _USUAL_NOISE),
    # 45 closures, over odometry that drifts by 2° a step.
    "sparse building": _Building(replace(WORLDS["building"], closures_per_keyframe=0.09), Noise(2.0, 0.03, 1.0, 0.05)),
    "hills": _Building(WORLDS["hills"], Noise(0.3, 0.01, 0.6, 0.05)),
}


def kinds(data: Callable[[], Path], names: Sequence[str] = ()) -> list[Kind]:
    """Those whose names, graph and condition, contain one of the given texts; without any, all.

    Args:
        data: the folder of the data sets, with ``slam/``; called if a chosen kind needs it.
        names: parts of names, upper or lower case.

    Raises:
        PoseSuiteError: a text that is in no name.
    """
    graphs = (*RECORDED_NOISE, *CLASSIC_NOISE, *SIMULATED)
    everything = [
        (graph, condition)
        for graph in graphs
        for condition in ((AS_RECORDED,) if graph in RECORDED_NOISE else tuple(CONDITIONS))
    ]
    for text in names:
        if not any(_matches(text, *kind) for kind in everything):
            raise PoseSuiteError(f"no kind's name contains {text!r}; names begin with {', '.join(graphs)}")
    chosen = [kind for kind in everything if not names or any(_matches(text, *kind) for text in names)]
    folder = data() / "slam" if any(graph not in SIMULATED for graph, _ in chosen) else Path()
    return [
        Kind(f"{graph}: {condition}", partial(_drawn, folder, graph, condition), is_random=graph not in RECORDED_NOISE)
        for graph, condition in chosen
    ]


def tiny_case() -> Case:
    """A square with one closure, on which one-time costs are paid."""
    turn = Rotation.from_rotvec(np.outer(np.arange(5), [0.0, 0.0, np.pi / 2]))
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    topology = ViewGraph.create([0, 1, 2, 3, 0], [1, 2, 3, 4, 4], np.eye(4)[[3] * 5], kind=[0, 0, 0, 0, 1])
    poses = Poses(turn.inv().as_quat(), corners, planar=True)
    drawn = redrawn(topology, poses, Noise(0.1, 0.01, 0.1, 0.01), np.random.default_rng(0))
    return known_case(CaseKey("warm-up"), drawn)


def _matches(text: str, graph: str, condition: str) -> bool:
    return text.casefold() in f"{graph}: {condition}".casefold()


def _drawn(folder: Path, graph: str, condition: str, seed: int) -> Case:
    if graph in RECORDED_NOISE:
        return recorded_case(graph, cases.b25b(graph.removeprefix("B25b_"), folder))
    rng = np.random.default_rng((seed, _STREAM, zlib.crc32(f"{graph}: {condition}".encode())))
    if graph in SIMULATED:
        drawn = _simulated(SIMULATED[graph], rng)
    else:
        topology, poses, stated = _classic(folder, graph)
        drawn = redrawn(topology, poses, CLASSIC_NOISE[graph], rng, stated)
    add = CONDITIONS[condition]
    spoiled = drawn if add is None else false_places.with_share(drawn, _SHARE, add, rng)
    if condition == JUMPS:
        spoiled = with_jumps(spoiled, _NUM_JUMPS, rng)
    return known_case(CaseKey(graph, condition, seed), spoiled)


def known_case(key: CaseKey, drawn: DrawnPoses) -> Case:
    """A drawn graph; its oracle uses every edge that was not made false."""
    truth = PoseTruth(
        torch.from_numpy(drawn.poses.position), torch.from_numpy(drawn.sigma), torch.from_numpy(drawn.stated)
    )
    precision = torch.from_numpy(drawn.sigma[:, 0] ** -2)
    orientations = torch.from_numpy(drawn.poses.body_from_world)
    intact = torch.from_numpy(~drawn.is_wrong)
    return Case(key, drawn.graph, orientations, SLAM, intact, _FLOOR, precision, truth)


def recorded_case(name: str, graph_file: GraphFile) -> Case:
    """One of :data:`RECORDED_NOISE`, with ground truth. Its oracle uses closures within 10° and 2 m of it."""
    assert graph_file.position_gt is not None
    sigma = RECORDED_NOISE[name].of(graph_file.graph.is_odometry.numpy())
    position = torch.from_numpy(graph_file.position_gt)
    truth = PoseTruth(position, torch.from_numpy(sigma), torch.from_numpy(stated_sigma(graph_file)))
    return replace(cases.recorded_case(name, graph_file), poses=truth)


def stated_sigma(graph_file: GraphFile) -> np.ndarray:
    """``(M, 2)`` rad and metres per component: of the file's information matrices, the mean over the axes."""
    information, precision = graph_file.edge_information, graph_file.graph.precision.numpy()
    assert information is not None
    # Entries of the upper triangle's diagonal that belong to x, y and z.
    shift = information[:, [0, 6] if graph_file.planar else [0, 6, 11]].mean(axis=1)
    return np.asarray(np.stack((precision, shift), axis=1) ** -0.5)


def _simulated(building: _Building, rng: np.random.Generator) -> DrawnPoses:
    run = simulate_slam_graph(replace(building.config, false_share=0.0), rng)
    world_from_body = torch.from_numpy(run.world_from_body)
    poses = Poses(inverse(world_from_body).numpy(), run.position, run.planar)
    return redrawn(run.graph, poses, building.noise, rng)


@lru_cache(maxsize=1)
def _classic(folder: Path, name: str) -> tuple[ViewGraph, Poses, np.ndarray]:
    """Edges, reference poses and what edges state.

    The reference is least squares on all edges, rotations first, or the simulation's own orientations where the graph
    is simulated; everything is drawn anew from it, so that any trajectory of the right shape would do.
    """
    graph_file = read_graph(folder / f"{name}.g2o")
    truth = folder / f"{name}_ground_truth.csv"
    graph_file = attach_truth(graph_file, truth) if truth.exists() else graph_file
    graph = graph_file.graph
    orientations = graph_file.body_from_world_gt
    if orientations is None:
        orientations = least_squares(graph, np.ones(graph.num_edges, dtype=bool)).numpy()
    assert graph.translation is not None
    edges = Translations(
        graph.source.numpy(),
        graph.target.numpy(),
        graph.translation.numpy(),
        graph.is_odometry.numpy(),
        np.zeros(graph.num_edges),
        graph.steps.numpy(),
    )
    world_from_body = inverse(torch.from_numpy(orientations)).numpy()
    position = fit_positions(world_from_body, edges, np.zeros((graph.num_nodes, 3)))
    return graph, Poses(orientations, position, graph_file.planar), stated_sigma(graph_file)
