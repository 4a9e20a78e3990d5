"""The SLAM suite: real and classic pose graphs, and what is done to them (false closures, slipping odometry)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.datasets.files.graph_file import GraphFile, read_graph
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.datasets.simulation.false_closures import FALSE_CLOSURE_DEG, insert_slips, replace_closures
from rotavg_ros.datasets.simulation.slip_places import CROSSED, LOCATABLE
from rotavg_ros.datasets.simulation.visual_odometry import odometry_graph
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.least_squares import least_squares
from rotavg_ros.evaluation.metrics import true_edge_noise
from rotavg_ros.view_graph import ViewGraph

# Errors below the floor count as the floor: with ground truth, and where clean least squares stands in for it.
_TRUTH_FLOOR = np.radians(0.1)
_REFERENCE_FLOOR = np.radians(0.3)
# Closures this close to the border between good and false do not count in verdicts.
_UNDECIDED_DEG = (8.0, 12.0)
_GROUPED_SHARE = 0.3
_SLIP_SHARE = 0.01
_SLIP_CLOSURE_SHARE = 0.3
# Keeps these random numbers apart from all that training draws.
_STREAM = 0x51A3

AS_RECORDED, GROUPED = "as recorded", "30 % grouped"
# Slips wherever two good closures lie across, and only where they cannot be taken for slips elsewhere.
SLIPS, LOCATABLE_SLIPS = "slips + 30 %", "locatable slips + 30 %"
SLIP_RULES = {SLIPS: CROSSED, LOCATABLE_SLIPS: LOCATABLE}
RANDOM = "% random"


class SlamSuiteError(UserError):
    """An unknown graph, or data that is not there; the message lists the choices or the remedy."""


@dataclass(frozen=True)
class SlamCase:
    """A pose graph to be solved, and what is known of it (N nodes, M edges).

    Attributes:
        graph_name, condition, seed: what was drawn.
        graph: the edges.
        truth: ``(N, 4)`` body_from_world that errors count against; NaN rows where unknown.
        floor: rad; smaller errors count as this.
        is_inlier: ``(M,)`` bool, the edges that the oracle knows to be good.
        noise: ``(M,)`` rad, true noise of every edge; NaN where unknown.
    """

    graph_name: str
    condition: str
    seed: int
    graph: ViewGraph
    truth: Tensor
    floor: float
    is_inlier: np.ndarray
    noise: np.ndarray

    @property
    def name(self) -> str:
        return f"{self.graph_name}, {self.condition}, seed {self.seed}"

    @property
    def is_closure(self) -> np.ndarray:
        """``(M,)`` bool."""
        return ~self.graph.is_odometry.numpy()

    @property
    def is_false(self) -> np.ndarray:
        """``(M,)`` bool: a loop closure whose noise is clearly above 10°."""
        return np.asarray(self.is_closure & (self.noise > np.radians(_UNDECIDED_DEG[1])))

    @property
    def is_good(self) -> np.ndarray:
        """``(M,)`` bool: a loop closure with noise clearly below 10°, and not because a random one happens to fit."""
        return np.asarray(self.is_closure & self.is_inlier & (self.noise < np.radians(_UNDECIDED_DEG[0])))


@dataclass(frozen=True)
class _Source:
    """Where a graph comes from.

    Attributes:
        read: folder of the SLAM data, random numbers → graph, with ground truth where there is one.
        is_spoiled: closures are made false and odometry slips; else the graph stays as it was recorded.
        is_redrawn: a part of the graph itself is random.
    """

    read: Callable[[Path, np.random.Generator], GraphFile]
    is_spoiled: bool = True
    is_redrawn: bool = False


def _classic(name: str, folder: Path, _: np.random.Generator) -> GraphFile:
    graph_file = read_graph(folder / f"{name}.g2o")
    truth = folder / f"{name}_ground_truth.csv"
    return attach_truth(graph_file, truth) if truth.exists() else graph_file


def _b25b(threshold: str, folder: Path, _: np.random.Generator) -> GraphFile:
    folder = folder / "b25b"
    stamped = attach_stamps(read_graph(folder / f"B25b_{threshold}.g2o"), folder / "B25b_timestamps.txt")
    return attach_truth(stamped, folder / "ground_truth.csv")


def _kitti(sequence: str, folder: Path, rng: np.random.Generator) -> GraphFile:
    folder = folder / "kitti_mono_vo"
    return odometry_graph(folder / f"{sequence}_pred.txt", folder / f"{sequence}_gt.txt", rng)


_CLASSIC = ("intel", "CSAIL", "FR079", "manhattan", "parking-garage", "sphere2500")
_SOURCES: dict[str, _Source] = {
    **{
        f"B25b_{threshold}": _Source(partial(_b25b, threshold), is_spoiled=False)
        for threshold in ("0.000", "0.250", "0.500")
    },
    **{name: _Source(partial(_classic, name)) for name in _CLASSIC},
    **{f"KITTI_{number}": _Source(partial(_kitti, number), is_redrawn=True) for number in ("00", "02", "05", "06")},
}
GRAPHS = tuple(_SOURCES)
SHARES = (0.0, 0.1, 0.3, 0.5, 0.8)


def share_condition(share: float) -> str:
    """Name of the condition that a share of the closures is random."""
    return f"{100 * share:g} {RANDOM}"


def cases(
    data: Path, graphs: Sequence[str], shares: Sequence[float], seeds: Sequence[int], hard: bool = True
) -> Iterator[SlamCase]:
    """Every graph under every condition with every seed; where nothing is random, once. Named twice is named once.

    Odometry slips only where good closures are dense enough (:data:`SLIP_RULES`); graphs without such places are left
    out.

    Args:
        data: folder of the data sets, with ``slam/``.
        shares: of false closures.
        hard: false closures in groups and slipping odometry, too.

    Raises:
        SlamSuiteError: an unknown graph, or no data.
    """
    graphs, shares, seeds = tuple(dict.fromkeys(graphs)), tuple(dict.fromkeys(shares)), tuple(dict.fromkeys(seeds))
    for name in graphs:
        if name not in _SOURCES:
            raise SlamSuiteError(f"unknown graph {name!r}; choose from {', '.join(GRAPHS)}")
    if not (data / "slam").is_dir():
        raise SlamSuiteError(f"{data}: lacks slam; see the documentation of the data sets")
    for name in graphs:
        source = _SOURCES[name]
        if not source.is_spoiled:
            yield recorded_case(name, source.read(data / "slam", np.random.default_rng(0)))
            continue
        conditions = [*((share_condition(share), share) for share in shares)]
        if hard:
            conditions += [(GROUPED, _GROUPED_SHARE), *((slips, _SLIP_CLOSURE_SHARE) for slips in SLIP_RULES)]
        for condition, share in conditions:
            once = share == 0 and not source.is_redrawn
            for seed in seeds[:1] if once else seeds:
                graph_file = source.read(data / "slam", _random(seed, name))
                case = spoiled_case(name, graph_file, condition, share, seed)
                if condition not in SLIP_RULES or not case.is_inlier[~case.is_closure].all():
                    yield case


def recorded_case(name: str, graph_file: GraphFile) -> SlamCase:
    """A graph with ground truth as it is. The oracle uses the closures that are known to be good."""
    assert graph_file.body_from_world_gt is not None
    graph, truth = graph_file.graph, torch.from_numpy(graph_file.body_from_world_gt)
    noise = true_edge_noise(graph.target_from_source, graph.source, graph.target, truth).numpy()
    is_inlier = graph.is_odometry.numpy() | (noise <= np.radians(FALSE_CLOSURE_DEG))
    return SlamCase(name, AS_RECORDED, 0, graph, truth, float(_TRUTH_FLOOR), is_inlier, noise)


def spoiled_case(name: str, graph_file: GraphFile, condition: str, share: float, seed: int) -> SlamCase:
    """A clean graph made worse. The oracle uses every edge that was left as it was."""
    truth, floor = _reference(graph_file)
    rng = _random(seed, f"{name} {condition}")
    spoiled = replace_closures(graph_file, truth, share, rng, grouped=condition == GROUPED)
    was_spoiled = spoiled.spoiled
    if condition in SLIP_RULES:
        spoiled = insert_slips(spoiled.graph_file, truth, _SLIP_SHARE, rng, rule=SLIP_RULES[condition])
        was_spoiled = was_spoiled | spoiled.spoiled
    graph = spoiled.graph_file.graph
    return SlamCase(name, condition, seed, graph, torch.from_numpy(truth), floor, ~was_spoiled, spoiled.noise)


def _reference(graph_file: GraphFile) -> tuple[np.ndarray, float]:
    """What errors count against, ``(N, 4)`` body_from_world, and their floor in radians."""
    if graph_file.body_from_world_gt is not None:
        return graph_file.body_from_world_gt, float(_TRUTH_FLOOR)
    everything = np.ones(graph_file.graph.num_edges, dtype=bool)
    return least_squares(graph_file.graph, everything).numpy(), float(_REFERENCE_FLOOR)


def _random(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng((seed, _STREAM, zlib.crc32(name.encode())))
