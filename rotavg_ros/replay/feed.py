"""Feeds a bag's messages into the estimator, with the converters that the node's subscriptions use."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.bags.reader import BagReader
from rotavg_ros.inputs import (
    EDGE_CONVERTERS,
    ODOMETRY_CONVERTERS,
    EdgeConverter,
    EdgeVerdict,
    OdometryConverter,
    OdometryRecord,
)
from rotavg_ros.online import EstimatorOptions, OnlineEstimator, RejectReason
from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.online.measurements import OdometryMessage, RejectedInputError
from rotavg_ros.online.odometry.time_jumps import KEEPS_TIME_LINE, BackwardJumps
from rotavg_ros.online.quaternion import IDENTITY, Quaternion
from rotavg_ros.replay.frames import BagFrames
from rotavg_ros.replay.plan import Input, Plan
from rotavg_ros.replay.record import Reference, positions_told
from rotavg_ros.settings.parameters import NodeParameters

# Called with the robot and its odometry whenever the estimator has taken a message of it.
OnOdometry = Callable[[str, OdometryRecord], None]


class Feed:
    """Passes messages on by topic.

    Args:
        estimator: receives all measurements.
        plan: the use of each topic.
        frames: the mounting of the sensors between which edges are measured.
        on_odometry: is told of every odometry message that was taken.
    """

    def __init__(self, estimator: OnlineEstimator, plan: Plan, frames: BagFrames, on_odometry: OnOdometry) -> None:
        self._estimator, self._frames = estimator, frames
        self._on_odometry = on_odometry
        self._generation = estimator.generation
        self._edge_converters: list[EdgeConverter] = []
        self._handlers: dict[str, list[Callable[[Any], None]]] = {}
        for robot, source, sensor in plan.odometry_of_robots():
            odometry = partial(self._take_odometry, robot, ODOMETRY_CONVERTERS[source.type_name], sensor)
            self._handlers.setdefault(source.topic, []).append(odometry)
        for source, about in zip(plan.edges, plan.parameters.edge_sources(), strict=True):
            convert = EDGE_CONVERTERS[source.type_name](about.into(estimator))
            self._edge_converters.append(convert)
            edges = partial(self._take_edges, convert, source.topic)
            self._handlers.setdefault(source.topic, []).append(edges)

    @property
    def topics(self) -> list[str]:
        """All topics that have to be read."""
        return list(self._handlers)

    def __call__(self, topic: str, message: Any) -> None:
        """Pass one message on."""
        for handle in self._handlers[topic]:
            handle(message)

    def _take_odometry(self, robot: str, convert: OdometryConverter, sensor: Quaternion, message: Any) -> None:
        try:
            record = convert(message, sensor)
        except RejectedInputError as rejection:
            self._estimator.reject(rejection.reason)
            return
        measured = record.stamp_ns, record.world_from_body, record.position
        if self._estimator.add_odometry(robot, *measured, sensor) is None:
            self._on_odometry(robot, record)

    def _take_edges(self, convert: EdgeConverter, topic: str, message: Any) -> None:
        if self._generation != self._estimator.generation:  # time went back: repeated edges are new again
            self._generation = self._estimator.generation
            for converter in self._edge_converters:
                converter.forget()
        for ends in self._estimator.pop_given_up():
            for converter in self._edge_converters:
                converter.note_given_up(*ends)
        for record in convert(message):
            if isinstance(record, EdgeVerdict):
                self._estimator.label_edge(record.source_robot, record.edge_id, record.label)
            elif isinstance(record.edge, RejectReason):
                self._estimator.reject(record.edge)
            else:
                self._estimator.add_edge(self._frames.edge_of_body(record.edge, record.frame_id, topic))


def read_references(
    bag: BagReader, inputs: Mapping[str, Input], parameters: NodeParameters, start_ns: int, stop_ns: int
) -> dict[str, Reference]:
    """The references in the bag's topics between two moments, by robot; those without a usable pose are left out."""
    options = parameters.estimator
    references = {
        robot: _reference(source.topic, list(_records(bag, source, start_ns, stop_ns)), options)
        for robot, source in inputs.items()
    }
    return {robot: reference for robot, reference in references.items() if len(reference.stamp_ns)}


def _reference(name: str, records: list[OdometryRecord], options: EstimatorOptions) -> Reference:
    time_line = _time_lines(records, options)
    in_order = np.lexsort((np.array([record.stamp_ns for record in records], dtype=np.int64), time_line))
    records, time_line = [records[row] for row in in_order], time_line[in_order]
    stamp_ns = np.array([record.stamp_ns for record in records], dtype=np.int64)
    orientation = _rows([record.world_from_body for record in records], 4)
    position = _rows([record.position or (np.nan,) * 3 for record in records], 3)
    length = np.linalg.norm(orientation, axis=1)
    is_last = np.concatenate(((np.diff(stamp_ns) > 0) | (np.diff(time_line) > 0), [True]))[: len(records)]
    sound = np.isfinite(length) & (length > 0) & is_last
    return Reference(
        name,
        stamp_ns[sound],
        orientation[sound] / length[sound, None],
        positions_told(position[sound]),
        time_line[sound] if time_line.any() else None,
    )


def _time_lines(records: list[OdometryRecord], options: EstimatorOptions) -> NDArray[np.int64]:
    """Number of the time line of each record, by the rule that the robots' odometry follows."""
    time_line = np.zeros(len(records), dtype=np.int64)
    if options.on_time_jump in KEEPS_TIME_LINE:
        return time_line
    jumps, taken_ns = BackwardJumps(), GrowingArray(np.int64)
    rule = options.time_jump_ns, options.on_time_jump
    late: list[tuple[int, OdometryMessage]] = []
    for row, record in enumerate(records):
        stamps_ns = [record.stamp_ns]
        if len(taken_ns) and record.stamp_ns <= taken_ns.view[-1]:
            message = OdometryMessage("reference", record.stamp_ns, record.world_from_body, record.position)
            late.append((row, message))
            since_jump = jumps.late(message, taken_ns.view, *rule)
            if not since_jump:
                continue
            stamps_ns = [each.stamp_ns for each in since_jump]
            time_line[next(first for first, each in late if each is since_jump[0]) :] += 1
        jumps.on_time("reference")
        late.clear()
        taken_ns.extend(np.array(stamps_ns))
    return time_line


def _records(bag: BagReader, source: Input, start_ns: int, stop_ns: int) -> Iterator[OdometryRecord]:
    for _, _, message in bag.decoded([source.topic], start_ns, stop_ns):
        try:
            yield ODOMETRY_CONVERTERS[source.type_name](message, IDENTITY)
        except RejectedInputError:
            continue


def _rows(values: list[Any], width: int) -> NDArray[np.float64]:
    return np.array(values, dtype=np.float64).reshape(-1, width)
