"""The estimator's whole state in one npz file: arrays only, nothing is ever unpickled."""

from __future__ import annotations

import glob
import json
import os
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.errors import UserError
from rotavg_ros.online.graph_builder import GraphBuilder
from rotavg_ros.online.growing_view_graph import GraphSnapshot, GrowingViewGraph
from rotavg_ros.online.keyframes import OdometryTrack
from rotavg_ros.online.marginalized_keyframes import MarginalizedIndex, MarginalizedKeyframes
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.view_graph import ViewGraph

FORMAT = "rotavg online state"
FORMAT_VERSION = 3
# Before it, odometry edges stood for one step each, and no keyframe was marginalised.
_FIRST_WITH_STEPS = 3
_READABLE = (2, FORMAT_VERSION)
_TEMPORARY = ".tmp"
_MARGINALIZED = "marginalized_"
_GRAPH_COLUMNS = ("source", "target", "target_from_source", "kind", "precision", "label", "steps")
_KEYFRAME_COLUMNS = ("keyframe_robot", "keyframe_id", "stamp_ns", "edge_id", "translation")

Arrays = dict[str, NDArray[Any]]


class StateFileError(UserError):
    """A state file cannot be read or written; the message names it and says what to do."""


@dataclass(frozen=True)
class State:
    """Everything that a state file holds.

    Attributes:
        arrays: by name.
        header: the rest, for JSON but for the pending edges.
        pending: edges that wait.
    """

    arrays: Arrays
    header: dict[str, Any]
    pending: list[EdgeMeasurement]

    def encoded(self) -> Arrays:
        """All of it as arrays; the header is JSON's bytes."""
        header = self.header | {"pending": [asdict(edge) for edge in self.pending]}
        return self.arrays | {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}


def collect(builder: GraphBuilder, answered: Tensor | None, version: int) -> State:
    """The state, mostly as views: quick, so that the estimator's lock is held only briefly."""
    snapshot = builder.graph.snapshot()
    arrays: Arrays = {name: getattr(snapshot, name) for name in _KEYFRAME_COLUMNS}
    arrays |= {name: getattr(snapshot.graph, name).numpy() for name in _GRAPH_COLUMNS}
    arrays["answered"] = np.empty((0, 4)) if answered is None else answered.numpy()
    arrays["fingerprints"] = builder.fingerprints.as_array()
    marginalized = snapshot.marginalized
    arrays |= {f"{_MARGINALIZED}{name}": values for name, values in marginalized.keyframes.arrays().items()}
    for index, track in enumerate(builder.tracks.values()):
        arrays |= {f"odometry{index}_{name}": values for name, values in track.arrays().items()}
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": version,
        "robots": snapshot.robots,
        "odometry_robots": list(builder.tracks),
        "data_time_ns": builder.data_time_ns,
        "rejected": dict(builder.rejected),
        "marginalized": builder.marginalized,
        "dropped_closures": builder.dropped_closures,
        "forgotten_up_to": list(marginalized.forgotten_up_to.items()),
        "labels": [[robot, edge_id, int(label)] for (robot, edge_id), label in builder.labels.items()],
    }
    return State(arrays, header, list(builder.pending))


def write(path: Path, arrays: Arrays) -> None:
    """Write beside the file and move into place, so that the file is always a whole one.

    Raises:
        StateFileError: the folder is missing or not writable, the disk is full.
    """
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=_TEMPORARY, dir=path.parent)
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        _synchronise(path.parent)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise StateFileError(f"cannot write the state file {path}: {error.strerror}") from error


def _synchronise(folder: Path) -> None:
    """Have the file's new name on the disk before anybody relies on it."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def remove_leftovers(path: Path) -> None:
    """Delete what was being written beside a state file when the process was killed."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*{_TEMPORARY}"):
        with suppress(OSError):
            leftover.unlink()


def read(path: Path) -> Arrays:
    """The arrays of a state file, complete (every array carries a checksum) and of this format.

    Raises:
        StateFileError: missing, foreign, truncated, corrupted, or of another format version.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        header = json.loads(arrays["header"].tobytes())
        if header["format"] != FORMAT:
            raise ValueError("another format")
        format_version = header["format_version"]
    except FileNotFoundError as error:
        raise StateFileError(f"there is no state file {path}; save one first") from error
    except OSError as error:
        raise StateFileError(f"cannot read the state file {path}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise StateFileError(f"{path} is not a whole state file of rotavg; delete it or save a new one") from error
    if format_version not in _READABLE:
        raise StateFileError(
            f"{path} has state format {format_version}, this version reads {FORMAT_VERSION}; save a new one"
        )
    if format_version < _FIRST_WITH_STEPS:
        nothing = MarginalizedKeyframes.none().arrays()
        arrays["steps"] = np.ones(len(arrays["edge_id"]))
        arrays |= {f"{_MARGINALIZED}{name}": values for name, values in nothing.items()}
    return arrays


def restore(arrays: Arrays, options: EstimatorOptions) -> tuple[GraphBuilder, Tensor | None, int]:
    """The builder, the last answer's orientations and the answers' version that :func:`collect` took.

    Raises:
        StateFileError: the arrays do not fit together.
    """
    try:
        return _restore(arrays, options)
    except (UserError, ValueError, KeyError, TypeError, IndexError, AttributeError, StopIteration) as error:
        raise StateFileError(f"the state file's content is inconsistent ({error}); save a new one") from error


def _restore(arrays: Arrays, options: EstimatorOptions) -> tuple[GraphBuilder, Tensor | None, int]:
    header = json.loads(arrays["header"].tobytes())
    num_keyframes = len(arrays["keyframe_id"])
    columns: dict[str, Any] = {name: arrays[name] for name in _GRAPH_COLUMNS}
    marginalized = {
        name.removeprefix(_MARGINALIZED): values for name, values in arrays.items() if name.startswith(_MARGINALIZED)
    }
    snapshot = GraphSnapshot(
        graph=ViewGraph.create(num_nodes=num_keyframes, **columns),
        robots=tuple(header["robots"]),
        marginalized=MarginalizedIndex.of(
            MarginalizedKeyframes(**marginalized), dict(header.get("forgotten_up_to", ()))
        ),
        revision=num_keyframes + len(arrays["edge_id"]),
        **{name: arrays[name] for name in _KEYFRAME_COLUMNS},
    )
    builder = GraphBuilder(options)
    builder.graph = GrowingViewGraph.from_snapshot(snapshot)
    for index, robot in enumerate(header["odometry_robots"]):
        prefix = f"odometry{index}_"
        track_arrays = {name.removeprefix(prefix): arrays[name] for name in arrays if name.startswith(prefix)}
        builder.tracks[robot] = OdometryTrack.from_arrays(
            options.odometry_bounds, track_arrays, options.continuity_limits
        )
    builder.data_time_ns = header["data_time_ns"]
    builder.rejected.update(header["rejected"])
    builder.marginalized = header.get("marginalized", 0)
    builder.dropped_closures = header.get("dropped_closures", 0)
    builder.labels = {(robot, edge_id): label for robot, edge_id, label in header["labels"]}
    for edge in header["pending"]:
        source, target = (KeyframeReference(**edge.pop(name)) for name in ("source", "target"))
        builder.add_edge(EdgeMeasurement(source=source, target=target, **edge))
    builder.fingerprints.update(arrays["fingerprints"].tolist())
    answered = torch.from_numpy(arrays["answered"])
    if answered.shape[1:] != (4,) or len(answered) > num_keyframes:
        raise ValueError("more orientations than keyframes")
    return builder, answered if len(answered) else None, header["version"]
