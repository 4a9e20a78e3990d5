"""The SLAM suite: real and classic pose graphs, and changes to them (false closures, slipping odometry)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.datasets.simulation.false_closures import insert_slips, replace_closures
from rotavg_ros.datasets.simulation.slip_places import CROSSED, LOCATABLE
from rotavg_ros.datasets.simulation.visual_odometry import odometry_graph
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.cases import SLAM, Case, CaseKey, Kind

# Errors below the floor count as the floor: with ground truth, and where clean least squares stands in for it.
_TRUTH_FLOOR = np.radians(0.1)
_REFERENCE_FLOOR = np.radians(0.3)
_GROUPED_SHARE = 0.3
_SLIP_SHARE = 0.01
_SLIP_CLOSURE_SHARE = 0.3
# Keeps these random numbers separate from all that training draws.
_STREAM = 0x51A3

AS_RECORDED, GROUPED = "as recorded", "30 % grouped"
# Slips wherever two good closures lie across, and only where they cannot be taken for slips elsewhere.
SLIPS, LOCATABLE_SLIPS = "slips + 30 %", "locatable slips + 30 %"
SLIP_RULES = {SLIPS: CROSSED, LOCATABLE_SLIPS: LOCATABLE}
RANDOM = "% random"
# Of graphs that stay as they were recorded also the beginnings, where closures are few: what a node has to answer from.
BEGINNINGS = {f"first {100 * share:g} %": share for share in (0.2, 0.3, 0.4, 0.6)}


class SlamSuiteError(UserError):
    """An unknown graph, or data that is not there; the message lists the choices or the remedy."""


@dataclass(frozen=True)
class _Source:
    """The source of a graph.

    Attributes:
        read: folder of the SLAM data, random numbers → graph, with ground truth where there is one.
        is_spoiled: whether closures are made false and odometry slips; otherwise the graph stays as recorded.
        is_redrawn: whether a part of the graph itself is random.
    """

    read: Callable[[Path, np.random.Generator], GraphFile]
    is_spoiled: bool = True
    is_redrawn: bool = False


def _classic(name: str, folder: Path, _: np.random.Generator) -> GraphFile:
    graph_file = read_graph(folder / f"{name}.g2o")
    truth = folder / f"{name}_ground_truth.csv"
    return attach_truth(graph_file, truth) if truth.exists() else graph_file


def b25b(threshold: str, folder: Path) -> GraphFile:
    """A recorded run with stamps and ground truth.

    Args:
        threshold: of the closures that were accepted, as in the file's name.
        folder: of the SLAM data.
    """
    folder = folder / "b25b"
    stamped = attach_stamps(read_graph(folder / f"B25b_{threshold}.g2o"), folder / "B25b_timestamps.txt")
    return attach_truth(stamped, folder / "ground_truth.csv")


def _recorded(threshold: str, folder: Path, _: np.random.Generator) -> GraphFile:
    return b25b(threshold, folder)


def _kitti(sequence: str, folder: Path, rng: np.random.Generator) -> GraphFile:
    folder = folder / "kitti_mono_vo"
    return odometry_graph(folder / f"{sequence}_pred.txt", folder / f"{sequence}_gt.txt", rng)


_CLASSIC = ("intel", "CSAIL", "FR079", "manhattan", "parking-garage", "sphere2500")
_SOURCES: dict[str, _Source] = {
    **{
        f"B25b_{threshold}": _Source(partial(_recorded, threshold), is_spoiled=False)
        for threshold in ("0.000", "0.250", "0.500")
    },
    **{name: _Source(partial(_classic, name)) for name in _CLASSIC},
    **{f"KITTI_{number}": _Source(partial(_kitti, number), is_redrawn=True) for number in ("00", "02", "05", "06")},
}
GRAPHS = tuple(_SOURCES)


def share_condition(share: float) -> str:
    """Name of the condition that a share of the closures is random."""
    return f"{100 * share:g} {RANDOM}"


def kinds(data: Path, graphs: Sequence[str], shares: Sequence[float], hard: bool = True) -> list[Kind]:
    """Every graph under every condition; where nothing is random, one drawing tells all. Named twice is named once.

    Graphs with false closures of their own stay as they are, whole and, with ``hard``, their first parts.

    Odometry slips only where good closures are dense enough (:data:`SLIP_RULES`); graphs without such places have no
    case of that kind.

    Args:
        data: folder of the data sets, with ``slam/``.
        shares: of false closures.
        hard: whether to include false closures in groups and slipping odometry.

    Raises:
        SlamSuiteError: an unknown graph, or no data.
    """
    graphs, shares = tuple(dict.fromkeys(graphs)), tuple(dict.fromkeys(shares))
    for name in graphs:
        if name not in _SOURCES:
            raise SlamSuiteError(f"unknown graph {name!r}; choose from {', '.join(GRAPHS)}")
    if not (data / "slam").is_dir():
        raise SlamSuiteError(f"{data}: lacks slam; see the documentation of the data sets")
    conditions = {share_condition(share): share for share in shares}
    if hard:
        conditions |= {GROUPED: _GROUPED_SHARE, **dict.fromkeys(SLIP_RULES, _SLIP_CLOSURE_SHARE)}
    found = []
    for name in graphs:
        source = _SOURCES[name]
        if not source.is_spoiled:
            found.append(Kind(AS_RECORDED, partial(_draw_recorded, data / "slam", name), is_random=False))
            for beginning, share in BEGINNINGS.items() if hard else ():
                begin = partial(_draw_beginning, data / "slam", name, beginning, share)
                found.append(Kind(beginning, begin, is_random=False))
            continue
        for condition, share in conditions.items():
            draw = partial(_draw_spoiled, data / "slam", name, condition, share)
            found.append(Kind(condition, draw, is_random=share > 0 or source.is_redrawn))
    return found


def _draw_recorded(folder: Path, name: str, _: int) -> Case:
    return recorded_case(name, _SOURCES[name].read(folder, np.random.default_rng(0)))


def _draw_beginning(folder: Path, name: str, kind: str, share: float, _: int) -> Case:
    whole = _draw_recorded(folder, name, 0)
    count = round(share * whole.graph.num_nodes)
    has_come = torch.maximum(whole.graph.source, whole.graph.target) < count
    graph = replace(whole.graph.select_edges(has_come), num_nodes=count)
    return replace(whole, key=CaseKey(name, kind), graph=graph, truth=whole.truth[:count])


def _draw_spoiled(folder: Path, name: str, condition: str, share: float, seed: int) -> Case | None:
    graph_file = _SOURCES[name].read(folder, _random(seed, name))
    case = spoiled_case(CaseKey(name, condition, seed), graph_file, share)
    has_slipped = not bool(case.is_inlier[~case.is_closure].all())
    return case if has_slipped or condition not in SLIP_RULES else None


def recorded_case(name: str, graph_file: GraphFile) -> Case:
    """A graph with ground truth as it is. The oracle uses the closures that are known to be good."""
    assert graph_file.body_from_world_gt is not None
    truth = torch.from_numpy(graph_file.body_from_world_gt)
    return Case(CaseKey(name, AS_RECORDED), graph_file.graph, truth, SLAM, floor=float(_TRUTH_FLOOR))


def spoiled_case(key: CaseKey, graph_file: GraphFile, share: float) -> Case:
    """A clean graph corrupted as the key's kind says. The oracle uses every edge that was left as it was.

    Args:
        share: of the closures that are made false.
    """
    truth, floor = _reference(graph_file)
    rng = _random(key.seed, f"{key.name} {key.kind}")
    spoiled = replace_closures(graph_file, truth, share, rng, grouped=key.kind == GROUPED)
    was_spoiled = spoiled.spoiled
    if key.kind in SLIP_RULES:
        spoiled = insert_slips(spoiled.graph_file, truth, _SLIP_SHARE, rng, rule=SLIP_RULES[key.kind])
        was_spoiled = was_spoiled | spoiled.spoiled
    intact = torch.from_numpy(~was_spoiled)
    # Only rotations were replaced, so translations would reveal which.
    graph = replace(spoiled.graph_file.graph, translation=None)
    return Case(key, graph, torch.from_numpy(truth), SLAM, intact, floor)


def _reference(graph_file: GraphFile) -> tuple[np.ndarray, float]:
    """The reference for errors, ``(N, 4)`` body_from_world, and their floor in radians."""
    if graph_file.body_from_world_gt is not None:
        return graph_file.body_from_world_gt, float(_TRUTH_FLOOR)
    everything = np.ones(graph_file.graph.num_edges, dtype=bool)
    return least_squares(graph_file.graph, everything).numpy(), float(_REFERENCE_FLOOR)


def _random(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng((seed, _STREAM, zlib.crc32(name.encode())))
