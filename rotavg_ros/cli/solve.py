"""What ``rotavg solve`` does: every graph solved and written, one after the other."""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np

from rotavg_ros.cli.main import EXIT_USER_ERROR, print_error, print_warning
from rotavg_ros.cli.options.solve import EDGE_FORMATS
from rotavg_ros.cli.poses import POSE_FILES, pose_files, write_corrected_poses
from rotavg_ros.cli.progress import working
from rotavg_ros.datasets.files.csv_writer import Column, edge_columns, orientation_columns, write_csv
from rotavg_ros.datasets.files.formats import read_graph, stem_of
from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.solver import Solution, methods, solve
from rotavg_ros.solver.solution import residual_deg, residual_m
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeKind, ViewGraph
from rotavg_ros.wording import counted, with_names

OUTLIER_THRESHOLD = 0.5
_ORIENTATIONS, _EDGES, _SUMMARY = "orientations.csv", "edges", "summary.json"


class SolveError(UserError):
    """Graphs, options or an output folder that do not fit together."""


@dataclass(frozen=True)
class Job:
    """One graph and the folder for its answer."""

    graph: Path
    output: Path


def run(arguments: argparse.Namespace) -> int:
    """Solve every graph; a bad one does not stop the others."""
    if arguments.without:
        if arguments.method != methods.DEFAULT_METHOD:
            methods.check_choices(arguments.method, arguments.profile, arguments.device)
            raise SolveError(
                f"--without leaves out parts of --method {methods.DEFAULT_METHOD}, not of {arguments.method}; leave "
                "one of the two options out"
            )
        arguments.method = methods.without(*arguments.without)
    jobs = plan(arguments.graphs, arguments.output, arguments.edges, poses=arguments.poses)
    solve_graph: Callable[[ViewGraph], Solution] = partial(
        solve,
        method=arguments.method,
        profile=arguments.profile,
        device=arguments.device,
        refinement_steps=arguments.refine,
        weights=arguments.weights,
    )
    if arguments.translation_scale == "none":
        solve_graph = _blind_to_translations(solve_graph)
    # One-time costs (loading weights, first kernels) are not charged to the graphs, and wrong options show before any
    # work. What only photo collections need is loaded with the first of them.
    warm = _Warm(solve_graph)
    warm.up(has_odometry=True)
    errors: list[UserError] = []
    for job in jobs:
        try:
            summary = solve_file(job, warm, arguments.edges, poses=arguments.poses)
        except UserError as mistake:
            errors.append(mistake)
        else:
            print(f"{job.graph}: {_told(summary)} → {job.output}", flush=True)
            if arguments.device == "cuda" and summary["profile"] == "slam":
                print_warning(f"{job.graph}: --device cuda has no effect; a robot's graph is solved on the CPU")
            for warning in summary["warnings"]:
                print_warning(f"{job.graph}: {warning}")
    for error in errors:
        print_error(error)
    return EXIT_USER_ERROR if errors else 0


def _blind_to_translations(solve_graph: Callable[[ViewGraph], Solution]) -> Callable[[ViewGraph], Solution]:
    return lambda graph: solve_graph(replace(graph, translation=None))


def _told(summary: dict[str, Any]) -> str:
    """The summary in a line. In a graph without odometry, closures are called edges."""
    edges, closures, flagged = (summary[name] for name in ("edges", "loop_closures", "flagged_closures"))
    odometry, slips = edges - closures, summary["outliers"] - flagged
    verdicts = f"{flagged} of {closures} {'closures' if odometry else 'edges'} flagged" if closures else "no closures"
    if slips:
        verdicts += f", {slips} of {odometry} odometry edges as well"
    components = counted(summary["components"], "component")
    return f"{summary['nodes']} nodes, {edges} edges, {verdicts}, {components}, {summary['solve_seconds']:.2f} s"


def solve_file(job: Job, solver: _Warm, edges: str, *, poses: bool = False) -> dict[str, Any]:
    """Read, solve and write one graph.

    Args:
        job: the graph and its output folder.
        solver: with its options.
        edges: format of the edges' file, or ``none``.
        poses: whether to write positions as well.

    Returns:
        The content of its ``summary.json``.
    """
    start = time.perf_counter()
    with working(f"reading {job.graph}"):
        graph_file = read_graph(job.graph)
    read_seconds = time.perf_counter() - start
    solve_graph = solver.for_graph(graph_file.graph)
    start = time.perf_counter()
    with working(f"solving {job.graph}"):
        solution = solve_graph(graph_file.graph)
    solve_seconds = time.perf_counter() - start
    summary = summarize(job.graph, graph_file, solution, read_seconds, solve_seconds)
    summary["files"] = _files(graph_file, edges, poses=poses)
    write_answer(job.output, graph_file, solution, summary, edges, poses=poses)
    return summary


def plan(graphs: list[Path], output: Path, edges: str, *, poses: bool = False) -> list[Job]:
    """Where each answer goes, after all checks that are possible before any work.

    Raises:
        SolveError: two graphs with one stem, an output folder that cannot be written, or a file that an answer would
            overwrite though it is no earlier one's.
    """
    graph_at = {os.path.realpath(graph): graph for graph in reversed(graphs)}
    jobs = [Job(graph, output if len(graphs) == 1 else output / stem_of(graph)) for graph in graphs]
    first_of: dict[Path, Path] = {}
    for job in jobs:
        other = first_of.setdefault(job.output, job.graph)
        if other is not job.graph:
            raise SolveError(f"{other} and {job.graph} would both go to {job.output}; solve them one by one")
        _check_writable(job.output)
        older, written = _older_files(job.output), _possible_files(edges, poses=poses)
        for name in sorted(older | written):
            path = job.output / name
            with asking_about(path, SolveError):
                exists, is_folder = path.exists(), path.is_dir()
            overwritten = graph_at.get(os.path.realpath(path))
            if overwritten is not None:
                raise SolveError(f"{overwritten} would be overwritten by the answer; choose another --output")
            if is_folder:
                raise SolveError(f"{path} is a folder; remove it or choose another --output")
            if exists and name not in older:
                raise SolveError(
                    f"{path} would be overwritten, though no earlier answer there lists it as its own; move it away or "
                    "choose another --output"
                )
    return jobs


def _files(graph_file: GraphFile, edges: str, *, poses: bool) -> list[str]:
    """Names of an answer's files."""
    return sorted(_possible_files(edges) | set(pose_files(graph_file) if poses else []))


def _possible_files(edges: str, *, poses: bool = False) -> set[str]:
    """Names of the files that an answer may have."""
    own = {_ORIENTATIONS, _SUMMARY, *(POSE_FILES if poses else ())}
    return own if edges == "none" else own | {f"{_EDGES}.{edges}"}


def _older_files(folder: Path) -> set[str]:
    """The files that the summary of an earlier answer lists, so that another program's graph.g2o is left alone."""
    try:
        names = json.loads((folder / _SUMMARY).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    possible = set().union(*(_possible_files(suffix, poses=True) for suffix in EDGE_FORMATS))
    if not (isinstance(names, list) and _SUMMARY in names):
        return set()
    return {name for name in possible if name in names}


def summarize(
    path: Path, graph_file: GraphFile, solution: Solution, read_seconds: float, solve_seconds: float
) -> dict[str, Any]:
    """The content of ``summary.json``."""
    outlier = solution.outlier_score > OUTLIER_THRESHOLD
    is_closure = ~graph_file.graph.is_odometry
    return {
        "graph": str(path),
        "nodes": graph_file.graph.num_nodes,
        "edges": graph_file.graph.num_edges,
        "components": int(solution.component.max()) + 1,
        "loop_closures": int(is_closure.sum()),
        "outliers": int(outlier.sum()),
        "flagged_closures": int((outlier & is_closure).sum()),
        "warnings": [
            *graph_file.warnings,
            *with_names(solution.warnings, lambda row: int(graph_file.node_ids[row])),
        ],
        "skipped": graph_file.skipped,
        "stage_seconds": solution.stage_seconds,
        "read_seconds": read_seconds,
        "solve_seconds": solve_seconds,
        "peak_memory_bytes": _peak_memory_bytes(),
        "device": solution.device,
        "method": solution.method,
        "profile": solution.profile,
        "version": __version__,
    }


def write_answer(
    output: Path,
    graph_file: GraphFile,
    solution: Solution,
    summary: dict[str, Any],
    edges: str,
    *,
    poses: bool = False,
) -> None:
    """Write all files into a temporary folder, then move them in place; other files of an older answer are deleted.

    Raises:
        SolveError: the folder cannot be written; an older answer is then still intact.
    """
    writers: dict[str, Callable[[BinaryIO], object]] = {
        _ORIENTATIONS: lambda file: write_csv(file, _orientation_columns(graph_file, solution)),
    }
    columns = _edge_columns(graph_file, solution)
    arrays: dict[str, Any] = {column.name: column.values for column in columns}
    if edges == "csv":
        writers[f"{_EDGES}.csv"] = lambda file: write_csv(file, columns)
    elif edges == "npz":
        writers[f"{_EDGES}.npz"] = lambda file: np.savez(file, **arrays)
    writers[_SUMMARY] = lambda file: file.write((json.dumps(summary, indent=2) + "\n").encode())
    try:
        output.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".unfinished.", dir=output, ignore_cleanup_errors=True) as workplace:
            folder = Path(workplace)
            for name, write in writers.items():
                with (folder / name).open("wb") as file:
                    write(file)
            if poses:
                _write_poses(folder, output, graph_file, solution)
            older = _older_files(output)
            for path in sorted(folder.iterdir()):
                os.replace(path, output / path.name)
            for name in older - set(summary["files"]):
                (output / name).unlink(missing_ok=True)
    except OSError as error:
        raise SolveError(f"{output}: cannot be written: {error.strerror or error}") from None


def _write_poses(folder: Path, output: Path, graph_file: GraphFile, solution: Solution) -> None:
    """Write the poses' files into the temporary folder of ``output``, whose name no message may tell."""
    try:
        write_corrected_poses(folder, graph_file, solution)
    except GraphFileError as error:
        raise SolveError(str(error).replace(str(folder), str(output))) from None


def _orientation_columns(graph_file: GraphFile, solution: Solution) -> list[Column]:
    world_from_body, component = solution.world_from_body.cpu().numpy(), solution.component.cpu().numpy()
    return orientation_columns(graph_file.node_ids, world_from_body, component, solution.uncertainty.cpu().numpy())


def _edge_columns(graph_file: GraphFile, solution: Solution) -> list[Column]:
    graph, ids = graph_file.graph, graph_file.node_ids
    score, judged = solution.outlier_score.cpu().numpy(), None
    if solution.rotation_score is not None:
        judged = solution.rotation_score.cpu().numpy(), residual_deg(graph, solution), residual_m(graph, solution)
    ends = ids[graph.source.cpu().numpy()], ids[graph.target.cpu().numpy()]
    return edge_columns(ends, score, score > OUTLIER_THRESHOLD, judged)


class _Warm:
    """A solver that has solved a graph of the same kind before."""

    def __init__(self, solve_graph: Callable[[ViewGraph], Solution]) -> None:
        self._solve_graph = solve_graph
        self._is_warm: set[bool] = set()

    def up(self, *, has_odometry: bool) -> None:
        """Warm up for a kind of graph."""
        if has_odometry not in self._is_warm:
            self._is_warm.add(has_odometry)
            with working("preparing (the first time on a machine code is compiled)"):
                self._solve_graph(_warm_up_graph(has_odometry))

    def for_graph(self, graph: ViewGraph) -> Callable[[ViewGraph], Solution]:
        """The solver, warm for a graph."""
        self.up(has_odometry=bool(graph.is_odometry.any()))
        return self._solve_graph


def _warm_up_graph(has_odometry: bool) -> ViewGraph:
    """A constant triangle that ``--profile auto`` takes for a SLAM graph or for an SfM graph."""
    kind = [EdgeKind.ODOMETRY if has_odometry else EdgeKind.LOOP_CLOSURE] * 2 + [EdgeKind.LOOP_CLOSURE]
    return ViewGraph.create([0, 1, 0], [1, 2, 2], [[0.0, 0.0, 0.0, 1.0]] * 3, kind=kind)


def _check_writable(folder: Path) -> None:
    with asking_about(folder, SolveError):
        above = (folder, *folder.absolute().parents)
        existing = next(path for path in above if path.exists() or path.is_symlink())
        is_folder = existing.is_dir()
    if not is_folder:
        raise SolveError(f"{existing} is not a folder; choose another --output")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise SolveError(f"{existing}: permission denied; choose another --output")


def _peak_memory_bytes() -> int:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Linux counts in KiB
