"""A replay's output folder: each file gets its final name when it is complete."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.datasets.files.csv_writer import Column, edge_columns, orientation_columns, write_csv
from rotavg_ros.datasets.files.pose_files import write_kitti, write_tum
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.online import Answer
from rotavg_ros.replay.corrected_graph import keyframe_ids, write_graph_of_run
from rotavg_ros.replay.record import RobotRecord, RunRecord
from rotavg_ros.replay.run import Outcome
from rotavg_ros.replay.summary import summarize

RECORDING = "run.mcap"
SUMMARY = "summary.json"

# What an answer has of whatever robot; those that are named by robots and pictures are not known before.
_USUAL = (
    *(RECORDING, SUMMARY, "orientations.csv", "edges.csv", "graph.g2o", "report.html"),
    *("trajectory.tum", "trajectory.kitti", "odometry.tum"),
)
_UNFINISHED = ".unfinished."  # followed by the process id


class OutputError(UserError):
    """An output folder that already exists, or cannot be written."""


@contextmanager
def output_folder(folder: Path, *, overwrite: bool) -> Iterator[tuple[Path, bool]]:
    """A temporary folder inside the output folder; its files are moved there when the block ends without an error.

    Then the files of an older replay and the temporary folders of killed replays are deleted; everything else in the
    folder stays. Yields the temporary folder, and whether an older replay's answer is to be replaced.

    Raises:
        OutputError: the folder is not empty (without ``overwrite``), has a file that would be replaced though no older
            answer lists it as its own, or cannot be written.
    """
    with asking_about(folder, OutputError):
        is_new, is_folder = not folder.exists(), folder.is_dir()
        left_over = [path for path in folder.iterdir() if _is_left_over(path)] if is_folder else []
        content = [path for path in folder.iterdir() if path not in left_over] if is_folder else []
    if not is_new and not is_folder:
        raise OutputError(f"{folder} is not a folder; choose another --output")
    if content and not overwrite:
        raise OutputError(f"{folder}: exists already; choose another --output or give --overwrite")
    older = _files_of(folder)
    others = sorted(path.name for path in content if path.name in _USUAL and path.name not in older)
    if others:
        raise OutputError(
            f"{folder / others[0]} would be overwritten, though no earlier answer there lists it as its own; move it "
            "away or choose another --output"
        )
    workplace = folder / f"{_UNFINISHED}{os.getpid()}"
    try:
        workplace.mkdir(parents=True)
        yield workplace, (folder / SUMMARY).exists()
        names = sorted(path.name for path in workplace.iterdir())
        for name in set(_files_of(folder)) - set(names):
            (folder / name).unlink(missing_ok=True)
        for name in names:
            os.replace(workplace / name, folder / name)
        for path in left_over:
            shutil.rmtree(path, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(workplace, ignore_errors=True)
        if is_new and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _is_left_over(path: Path) -> bool:
    """Whether it is the temporary folder of a process that no longer exists."""
    number = path.name.removeprefix(_UNFINISHED)
    if number == path.name or not number.isdecimal():
        return False
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):  # another user's process; too large for a process id
        return False
    return int(number) == os.getpid()


def _files_of(folder: Path) -> list[str]:
    """The files that an older summary lists as its own."""
    try:
        names = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    listed = names if isinstance(names, list) else []  # another program's summary may list anything
    return [name for name in listed if isinstance(name, str) and Path(name).name == name]


def write_tables(folder: Path, record: RunRecord) -> None:
    """Write trajectories, graph and csv files.

    Args:
        folder: where to write them.
        record: the run.

    Raises:
        GraphFileError: a file cannot be written.
        OSError: likewise.
    """
    answer = record.answer
    with (folder / "orientations.csv").open("wb") as file:
        write_csv(file, _orientation_columns(answer))
    with (folder / "edges.csv").open("wb") as file:
        write_csv(file, _edge_columns(answer))
    several = len(record.robots) > 1
    for robot, name in zip(record.robots, _file_names([robot.robot for robot in record.robots]), strict=True):
        prefix = f"{name}_" if several else ""
        _write_trajectory(folder, f"{name}" if several else "trajectory", f"{prefix}odometry", robot)
    write_graph_of_run(folder / "graph.g2o", record)


def _file_names(robots: Sequence[str]) -> list[str]:
    """What each robot's files are called: its name as far as files can have it, and a number where two would share."""
    names: list[str] = []
    taken: set[str] = set()
    for robot in robots:
        wanted = re.sub(r"[^\w.-]+", "_", robot).strip("_") or "robot"
        numbered = (f"{wanted}_{number}" for number in count(2))
        name = next(name for name in chain([wanted], numbered) if taken.isdisjoint(_stems(name)))
        names.append(name)
        taken |= _stems(name)
    return names


def _stems(name: str) -> set[str]:
    """Names of a robot's trajectories, corrected and of its odometry."""
    return {name, f"{name}_odometry"}


def write_summary(folder: Path, record: RunRecord, bag: Path, outcome: Outcome) -> dict[str, Any]:
    """Write ``summary.json``, last of all, and return its content."""
    names = sorted({path.name for path in folder.iterdir()} | {SUMMARY})
    summary = {**summarize(record, bag, outcome), "files": names}
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    return summary


def _write_trajectory(folder: Path, name: str, odometry_name: str, robot: RobotRecord) -> None:
    """Write poses; those with stamps go to a file per time line: the last to the plain name, earlier ones numbered."""
    nothing = np.zeros((len(robot.stamp_ns), 3))
    position = nothing if robot.position is None else np.nan_to_num(robot.position)
    odometry = nothing if robot.odometry_position is None else np.nan_to_num(robot.odometry_position)
    write_kitti(folder / f"{name}.kitti", position, robot.world_from_body)
    has_odometry = np.isfinite(robot.odometry_world_from_body).all(axis=1)
    for line in np.unique(robot.time_line).tolist():
        suffix = "" if line == robot.time_line.max() else f"_time_line_{line}"
        chosen = robot.time_line == line
        _write_tum(folder / f"{name}{suffix}.tum", robot.stamp_ns, position, robot.world_from_body, chosen)
        chosen &= has_odometry
        if chosen.any():
            path = folder / f"{odometry_name}{suffix}.tum"
            _write_tum(path, robot.stamp_ns, odometry, robot.odometry_world_from_body, chosen)


def _write_tum(
    path: Path,
    stamp_ns: NDArray[np.int64],
    position: NDArray[np.float64],
    world_from_body: NDArray[np.float64],
    chosen: NDArray[np.bool_],
) -> None:
    write_tum(path, stamp_ns[chosen], position[chosen], world_from_body[chosen])


def _orientation_columns(answer: Answer) -> list[Column]:
    """As `rotavg solve` writes them; with several robots, the robot's number is the last column."""
    order = np.lexsort((answer.keyframe_id, answer.keyframe_robot))
    columns = orientation_columns(
        keyframe_ids(answer)[order], answer.world_from_body[order], answer.component[order], answer.uncertainty[order]
    )
    if len(answer.robots) > 1:
        columns.append(Column("robot", answer.keyframe_robot[order]))
    return columns


def _edge_columns(answer: Answer) -> list[Column]:
    """As `rotavg solve` writes them, and the senders' ids; with several robots, their numbers are the last columns."""
    ids, robot, judged = keyframe_ids(answer), answer.keyframe_robot, None
    if answer.rotation_score is not None and answer.residual_m is not None:
        judged = answer.rotation_score, answer.residual_deg, answer.residual_m
    columns = edge_columns((ids[answer.source], ids[answer.target]), answer.outlier_score, answer.outlier, judged)
    columns.append(Column("edge_id", answer.edge_id))
    if len(answer.robots) > 1:
        columns += [Column("source_robot", robot[answer.source]), Column("target_robot", robot[answer.target])]
    return columns
