"""What a state file holds: everything that decides how the graph goes on growing, as arrays and a JSON header."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros.errors import UserError
from rotavg_ros.online.answer.anchoring import corrections
from rotavg_ros.online.answer.gauge import is_numbered_by_first_node
from rotavg_ros.online.answer.last_answer import LastAnswer
from rotavg_ros.online.answer.screening import Known
from rotavg_ros.online.compaction.marginalized_keyframes import Forgotten, MarginalizedIndex, MarginalizedKeyframes
from rotavg_ros.online.content import ContentState
from rotavg_ros.online.graph.builder import GraphBuilder
from rotavg_ros.online.graph.fingerprints import Fingerprints
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.graph.growth import Growth
from rotavg_ros.online.graph.pending import PendingEdges, Waiting
from rotavg_ros.online.graph.provisional import Provisional, ProvisionalEdges
from rotavg_ros.online.graph.room import Room
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference
from rotavg_ros.online.odometry.data_time import DataTime
from rotavg_ros.online.odometry.time_jumps import BackwardJumps
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.state.file import FORMAT, FORMAT_VERSION, Arrays, StateFileError
from rotavg_ros.online.state.upgrade import upgraded
from rotavg_ros.solver import KeptLabels
from rotavg_ros.view_graph import ViewGraph

_MARGINALIZED = "marginalized_"
_FINGERPRINTS = "fingerprints_"
_LABELS = "labels_"
_GRAPH_COLUMNS = ("source", "target", "target_from_source", "kind", "precision", "label", "steps")
_KEYFRAME_COLUMNS = ("keyframe_robot", "keyframe_id", "stamp_ns", "time_line", "edge_id", "translation")


@dataclass(frozen=True)
class State:
    """Everything that a state file holds.

    Attributes:
        arrays: by name.
        header: everything else in JSON's types, except the pending edges.
        pending: edges that wait.
    """

    arrays: Arrays
    header: dict[str, Any]
    pending: list[Waiting]

    def encoded(self) -> Arrays:
        """All of it as arrays; the header becomes the bytes of its JSON."""
        header = self.header | {"pending": [asdict(waiting) for waiting in self.pending]}
        return self.arrays | {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)}


def collect(content: ContentState) -> State:
    """The state, mostly as views; this is quick, so the estimator's lock is held only briefly."""
    growth, last = content.growth, content.last
    snapshot = growth.graph.snapshot()
    marginalized = snapshot.marginalized
    arrays: Arrays = {name: getattr(snapshot, name) for name in _KEYFRAME_COLUMNS}
    arrays |= {name: getattr(snapshot.graph, name).numpy() for name in _GRAPH_COLUMNS}
    if snapshot.graph.route is not None and snapshot.graph.routes is not None:
        arrays |= {"route": snapshot.graph.route.numpy(), "routes": snapshot.graph.routes.numpy()}
    arrays["answered"] = np.empty((0, 4)) if last.body_from_world is None else last.body_from_world.numpy()
    labels = _labels(content)
    # Without labels the next answer starts from scratch, not from the last one.
    known = last.component if labels else None
    arrays["component"] = np.empty(0, dtype=np.int64) if known is None else known.numpy()
    arrays["outlier"], arrays["queued"] = last.outlier, np.flatnonzero(last.queue.waits)
    arrays |= _prefixed(_LABELS, labels)
    arrays |= _prefixed(_FINGERPRINTS, growth.fingerprints.arrays())
    arrays |= _prefixed(_MARGINALIZED, marginalized.keyframes.arrays())
    for index, track in enumerate(growth.tracks.values()):
        arrays |= _prefixed(f"odometry{index}_", track.arrays())
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": content.version,
        "ticked_revision": content.ticked_revision,
        "world_from_odometry": dict(content.world_from_odometry),
        "revision": snapshot.revision,
        "robots": snapshot.robots,
        "odometry_robots": list(growth.tracks),
        "data_times": {robot: asdict(time) for robot, time in growth.data_times.items()},
        "backward_jumps": growth.backward_jumps.header(),
        "rejected": dict(growth.rejected),
        "room": asdict(growth.room),
        "provisional": [asdict(each) for each in growth.provisional.all()],
        "forgotten_up_to": list(marginalized.forgotten.ids.items()),
        "forgotten_stamps": [[*key, stamp_ns] for key, stamp_ns in marginalized.forgotten.stamps_ns.items()],
        "labels": [[robot, edge_id, int(label)] for (robot, edge_id), label in growth.labels.items()],
    }
    return State(arrays, header, growth.pending.waiting())


def _labels(content: ContentState) -> Arrays:
    """The labels that the solver remembers, in the graph's own order of edges; empty if they are of another graph.

    The solver keeps edges in the order in which they entered.
    """
    kept: KeptLabels | None = getattr(content.memory, "labels", None)
    if kept is None:
        return {}
    graph = content.growth.graph.snapshot().graph
    order, count = content.last.queue.order, len(kept.trusted)
    edges = np.arange(graph.num_edges) if order is None else order
    if count > len(edges):
        return {}
    edges = edges[:count]
    for name in ("source", "target", "target_from_source", "kind", "label"):
        if not np.array_equal(getattr(graph, name).numpy()[edges], getattr(kept.graph, name).numpy()[:count]):
            return {}
    return kept.of_edges(edges, graph.num_edges)


def restore(arrays: Arrays, options: EstimatorOptions) -> ContentState:
    """Restore what :func:`collect` took.

    Raises:
        StateFileError: the arrays do not fit together.
    """
    try:
        return _restore(*upgraded(arrays, json.loads(arrays["header"].tobytes())), options)
    except (UserError, ValueError, KeyError, TypeError, IndexError, AttributeError, StopIteration) as error:
        raise StateFileError(f"the state file's content is inconsistent ({error}); save a new one") from error


def _restore(arrays: Arrays, header: dict[str, Any], options: EstimatorOptions) -> ContentState:
    graph = _graph(arrays, header)
    answered = torch.from_numpy(arrays["answered"])
    if answered.shape[1:] != (4,) or len(answered) > graph.num_keyframes:
        raise ValueError("more orientations than keyframes")
    if arrays["outlier"].dtype != bool or len(arrays["outlier"]) > graph.num_edges:
        raise ValueError("more flags than edges")
    queued = np.zeros(graph.num_edges, dtype=bool)
    queued[arrays["queued"]] = True
    component = torch.from_numpy(arrays["component"])
    if len(component) not in {0, len(answered)} or not is_numbered_by_first_node(component):
        raise ValueError("components of other keyframes")
    view_graph = graph.snapshot().graph
    memory = _kept_labels(_with_prefix(_LABELS, arrays), view_graph, queued)
    goes_on_from = component if len(component) and memory is not None else None
    solved = torch.from_numpy(np.flatnonzero(~queued[: len(arrays["outlier"])]))
    told = Known.of_orientations(answered, view_graph.select_edges(solved)) if len(answered) else None
    last = LastAnswer(answered if len(answered) else None, goes_on_from, arrays["outlier"], queued, told)
    growth = Growth(
        options,
        last,
        _pending(header["pending"], options),
        Fingerprints.from_arrays(options.max_edges, _with_prefix(_FINGERPRINTS, arrays)),
        graph,
        {
            robot: OdometryTrack.from_arrays(
                options.odometry_bounds, _with_prefix(f"odometry{index}_", arrays), options.continuity_limits
            )
            for index, robot in enumerate(header["odometry_robots"])
        },
        BackwardJumps.from_header(header["backward_jumps"]),
        Counter(header["rejected"]),
        {(robot, edge_id): label for robot, edge_id, label in header["labels"]},
        Room(**header["room"]),
        {robot: DataTime(**time) for robot, time in header["data_times"].items()},
        _provisional(header["provisional"], graph.num_edges),
    )
    builder = GraphBuilder(growth)
    for row in header.get("unplaced", ()):
        builder.add_edge(_edge(row))
    known = header["world_from_odometry"]
    if known is not None:
        world_from_odometry = {robot: (x, y, z, w) for robot, (x, y, z, w) in known.items()}
    else:
        world_from_odometry = {} if last.body_from_world is None else corrections(builder, last.body_from_world)
    return ContentState(growth, last, header["version"], header["ticked_revision"], world_from_odometry, memory)


def _kept_labels(arrays: Arrays, graph: ViewGraph, queued: NDArray[np.bool_]) -> KeptLabels | None:
    """The labels in the order in which edges enter now; None if they are invalid: then a whole search comes first."""
    entered = np.flatnonzero(~queued)
    with suppress(KeyError, ValueError, IndexError):
        # Files of before do not say about which axis a bias is.
        now = {"bias_axis": np.empty(0)} | arrays
        now |= {name: arrays[name][..., entered] for name in ("trusted", "places")}
        return KeptLabels.of_arrays(graph.select_edges(torch.from_numpy(entered)), now)
    return None


def _graph(arrays: Arrays, header: dict[str, Any]) -> GrowingViewGraph:
    columns: dict[str, Any] = {name: arrays[name] for name in _GRAPH_COLUMNS}
    checked = ViewGraph.create(num_nodes=len(arrays["keyframe_id"]), **columns)
    as_saved = torch.from_numpy(arrays["target_from_source"])  # the check may have rounded it
    routes: dict[str, Any] = {name: torch.from_numpy(arrays[name]) for name in ("route", "routes") if name in arrays}
    return GrowingViewGraph.from_snapshot(
        GraphSnapshot(
            graph=replace(checked, target_from_source=as_saved, **routes),
            robots=tuple(header["robots"]),
            marginalized=MarginalizedIndex.of(
                MarginalizedKeyframes(**_with_prefix(_MARGINALIZED, arrays)), _forgotten(header)
            ),
            revision=header["revision"],
            **{name: arrays[name] for name in _KEYFRAME_COLUMNS},
        )
    )


def _forgotten(header: dict[str, Any]) -> Forgotten:
    ids = dict(header["forgotten_up_to"])
    # Files of before do not have the stamps; there a keyframe that was named by its stamp had that for its id.
    rows = header.get("forgotten_stamps", [[robot, 0, keyframe_id] for robot, keyframe_id in ids.items()])
    return Forgotten(ids, {(robot, time_line): stamp_ns for robot, time_line, stamp_ns in rows})


def _pending(rows: list[dict[str, Any]], options: EstimatorOptions) -> PendingEdges:
    pending = PendingEdges(options.pending_capacity, options.pending_timeout_ns)
    pending.take(
        Waiting(**(row | {"edge": _edge(row["edge"]), "waits_for": KeyframeReference(**row["waits_for"])}))
        for row in rows
    )
    return pending


def _provisional(rows: list[dict[str, Any]], num_edges: int) -> ProvisionalEdges:
    if not all(0 <= row["row"] < num_edges for row in rows):
        raise ValueError("a provisional edge that is not there")
    return ProvisionalEdges(
        Provisional(_edge(row["edge"]), KeyframeReference(**row["waits_for"]), row["row"]) for row in rows
    )


def _edge(row: dict[str, Any]) -> EdgeMeasurement:
    ends = {name: KeyframeReference(**row[name]) for name in ("source", "target")}
    return EdgeMeasurement(**(row | ends))


def _prefixed(prefix: str, arrays: dict[str, NDArray[Any]]) -> Arrays:
    return {f"{prefix}{name}": values for name, values in arrays.items()}


def _with_prefix(prefix: str, arrays: Arrays) -> Arrays:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
