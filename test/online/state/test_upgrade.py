"""State files of earlier versions: what they hold goes on as if this version had written it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.state import file as state_file

SECOND = 1_000_000_000
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0)


def feed(online: OnlineEstimator, start: int, stop: int) -> None:
    for index in range(start, stop):
        turn = (0.0, 0.0, math.sin(0.05 * index), math.cos(0.05 * index))
        position = (9 + 0.1 * index, 1, 0) if index < 60 else (0.1 * (index - 60), 0, 0)
        online.add_odometry("r", (1000 + index) * SECOND, turn, position)


def closure(edge_id: int, source: KeyframeReference, target: KeyframeReference) -> EdgeMeasurement:
    return EdgeMeasurement(edge_id, source, target, (0.0, 0.0, 0.0, 1.0))


def as_of_version(path: Path, version: int) -> dict:
    """The content of a file of today, as that version wrote it."""
    arrays = state_file.read(path)
    header = json.loads(arrays.pop("header").tobytes())
    names = ("older", "younger", "newest")
    arrays["fingerprints"] = np.concatenate([arrays.pop(f"fingerprints_{name}") for name in names])
    added = ("time_line", "limit", "refused_", "begins_time_line", "outlier", "queued", "component")
    arrays = {name: values for name, values in arrays.items() if not any(word in name for word in added)}
    room = header.pop("room")
    old = {
        "format_version": version,
        "data_time_ns": header.pop("data_times")["r"]["now_ns"],
        "pending": [row["edge"] for row in header["pending"]],
        "marginalized": room["marginalized"],
        "dropped_closures": room["dropped_closures"],
    }
    for name in ("ticked_revision", "world_from_odometry", "revision", "backward_jumps"):
        del header[name]
    if version < 3:
        arrays = {name: values for name, values in arrays.items() if not name.startswith("marginalized_")}
        del arrays["steps"], header["forgotten_up_to"]
    return arrays | {"header": np.frombuffer(json.dumps(header | old).encode(), dtype=np.uint8)}


@pytest.mark.parametrize("version", [2, 3])
def test_it_goes_on(solver, tmp_path, version: int) -> None:
    today, path = OnlineEstimator(OPTIONS, solver), tmp_path / "state.npz"
    feed(today, 0, 80)  # odometry begins anew in between
    stamps = KeyframeReference("r", stamp_ns=1003 * SECOND), KeyframeReference("r", stamp_ns=1040 * SECOND + 5)
    assert today.add_edge(closure(5, *stamps)) is None
    today.add_edge(closure(6, KeyframeReference("r", 0), KeyframeReference("r", 85)))
    today.tick()
    feed(today, 80, 82)
    today.save(path)
    state_file.write(path, as_of_version(path, version))
    again = OnlineEstimator(OPTIONS, solver)
    again.load(path)
    # How long an edge has waited was not kept; it begins to wait anew.
    assert again.counts() == replace(today.counts(), longest_pending_s=0.0) and again.counts().pending == 1
    assert again.current_orientation("r") == pytest.approx(today.current_orientation("r"))
    for each in (today, again):
        feed(each, 82, 90)
        assert each.add_edge(closure(5, *stamps)) == "duplicate_edge"
    first, second = today.tick(force_cold=True), again.tick(force_cold=True)
    for name in ("keyframe_id", "stamp_ns", "time_line", "edge_id", "source", "target", "world_from_body"):
        np.testing.assert_allclose(getattr(second, name), getattr(first, name), atol=1e-12, err_msg=name)
    again.save(path)
    assert json.loads(state_file.read(path)["header"].tobytes())["format_version"] == state_file.FORMAT_VERSION


def test_edges_of_a_file_with_one_data_time_wait_in_that_of_their_robot(solver, tmp_path) -> None:
    """As version 7 wrote them; a robot whose clock is ahead had lengthened what they seem to have waited."""
    today, path = OnlineEstimator(replace(OPTIONS, pending_timeout_s=30.0), solver), tmp_path / "state.npz"
    feed(today, 0, 60)
    today.add_edge(closure(6, KeyframeReference("r", 0), KeyframeReference("r", 1000)))
    today.save(path)
    arrays = state_file.read(path)
    header = json.loads(arrays.pop("header").tobytes())
    del header["data_times"], header["pending"][0]["timed_by"]
    header |= {"format_version": 7, "data_time": {"now_ns": 5000 * SECOND, "claimed_ns": None}}
    state_file.write(path, arrays | {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)})
    again = OnlineEstimator(today.options, solver)
    again.load(path)
    feed(again, 60, 80)
    assert again.counts().pending == 1
    feed(again, 80, 95)
    assert again.counts().pending == 0 and again.counts().rejected["pending_timeout"] == 1


def test_without_labels_the_first_answer_is_from_nothing(tmp_path) -> None:
    """As version 5 wrote them."""
    today, path = OnlineEstimator(OPTIONS), tmp_path / "state.npz"
    feed(today, 0, 60)
    today.add_edge(closure(5, KeyframeReference("r", 0), KeyframeReference("r", 50)))
    today.tick()
    today.save(path)
    arrays = state_file.read(path)
    header = json.loads(arrays["header"].tobytes()) | {"format_version": 5}
    arrays = {name: value for name, value in arrays.items() if not name.startswith(("component", "labels_"))}
    state_file.write(path, arrays | {"header": np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)})
    again = OnlineEstimator(OPTIONS)
    again.load(path)
    answer = again.tick()
    assert answer is not None and answer.was_cold
