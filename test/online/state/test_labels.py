"""A graph that is loaded goes on from its labels: the first answer takes no search."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import solve
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.evaluation.live.feed import Feed
from rotavg_ros.online import Answer, EstimatorOptions, OnlineEstimator
from rotavg_ros.online.state import file as state_file
from rotavg_ros.solver import KeptLabels
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

OPTIONS = EstimatorOptions(keyframe_source="edges", gauge="identity")
KIND = "building: 30 % random"


def drawn(with_places: bool) -> ViewGraph:
    case = next(kind for kind in KINDS if kind.name == KIND).drawn(1)
    return replace(case.graph, translation=torch.from_numpy(case.edge_translation) if with_places else None)


def answered(online: OnlineEstimator) -> Answer:
    answer = online.tick()
    assert answer is not None
    return answer


def loaded(path: Path, options: EstimatorOptions = OPTIONS) -> OnlineEstimator:
    online = OnlineEstimator(options)
    online.load(path)
    return online


def is_without_a_search(answer: Answer) -> bool:
    return set(answer.stage_seconds) == {"update"}


def apart_deg(one: Answer, other: Answer) -> float:
    count = min(len(one.world_from_body), len(other.world_from_body))
    cosine = np.abs((one.world_from_body[:count] * other.world_from_body[:count]).sum(axis=1))
    return float(np.degrees(2 * np.arccos(np.minimum(cosine, 1.0))).max())


@pytest.mark.parametrize("with_places", [False, pytest.param(True, marks=pytest.mark.large)])
def test_it_answers_at_once_and_ends_where_a_solve_from_nothing_does(with_places: bool, tmp_path: Path) -> None:
    graph, path = drawn(with_places), tmp_path / "state.npz"
    online = OnlineEstimator(OPTIONS)
    feed = Feed(graph, online)
    feed.until(graph.num_nodes - 20)
    online.tick()
    for end in range(graph.num_nodes - 15, graph.num_nodes - 5, 5):
        feed.until(end)
        before = answered(online)
    online.save(path)
    again = loaded(path)
    feed_again = Feed(graph, again)
    feed_again._given = feed._given
    first = answered(again)
    assert is_without_a_search(first) and not first.was_cold
    assert apart_deg(first, before) < 3 * np.degrees(np.nanmax(before.uncertainty))
    assert (first.outlier != before.outlier).sum() <= 2
    feed_again.until(graph.num_nodes)
    assert is_without_a_search(answered(again))
    worked = 1.0
    answer = first
    while (newer := again.tick()) is not None or worked:
        answer, worked = newer or answer, again.go_on()
    cold = solve(again.snapshot().graph, profile="slam")
    assert answer.was_cold
    np.testing.assert_allclose(answer.outlier_score, cold.outlier_score.numpy(), atol=1e-9)


def test_closures_that_waited_wait_again(tmp_path: Path) -> None:
    graph, path = drawn(False), tmp_path / "state.npz"
    online = OnlineEstimator(OPTIONS)
    Feed(graph, online).until(graph.num_nodes)
    before = answered(online)
    queue = online._content.state.last.queue
    closures = np.flatnonzero(~graph.is_odometry.numpy())
    assert len(queue) == 0 and len(closures) > 30
    # As if the first had entered last, and the last ten not at all.
    order = np.arange(before.outlier.size)
    order = np.concatenate((np.delete(order, closures[[0, *range(-10, 0)]]), closures[:1]))
    queue.waits = np.zeros(len(before.outlier), dtype=bool)
    queue.waits[closures[-10:]] = True
    queue.order = order
    kept = online._content.state.memory.labels
    online._content.state.memory = replace(
        kept,
        graph=kept.graph.select_edges(torch.from_numpy(order)),
        trusted=kept.trusted[order],
        places=kept.places[:, order],
    )
    online.save(path)
    again = loaded(path)
    assert again.counts().queued == 10
    found = again._content.state.memory
    assert isinstance(found, KeptLabels)
    entered = np.sort(order)
    np.testing.assert_array_equal(found.trusted, kept.trusted[entered])
    assert torch.equal(found.graph.target_from_source, kept.graph.target_from_source[torch.from_numpy(entered)])
    assert is_without_a_search(answered(again))


def test_labels_of_another_graph_are_not_kept(tmp_path: Path) -> None:
    """Somebody has told better since the last answer."""
    graph, path = drawn(False), tmp_path / "state.npz"
    online = OnlineEstimator(OPTIONS)
    Feed(graph, online).until(graph.num_nodes)
    answer = answered(online)
    online.save(path)
    assert is_without_a_search(answered(loaded(path)))
    closure = int(answer.edge_id[np.flatnonzero(answer.kind == 1)[0]])
    assert online.label_edge("robot", closure, EdgeLabel.REJECTED) == 1
    online.save(path)
    assert not any(name.startswith("labels_") for name in state_file.read(path))
    assert not is_without_a_search(answered(loaded(path)))


@pytest.mark.large
def test_other_options_other_answers(tmp_path: Path) -> None:
    graph, path = drawn(True), tmp_path / "state.npz"
    online = OnlineEstimator(OPTIONS)
    Feed(graph, online).until(graph.num_nodes)
    online.tick()
    online.save(path)
    answer = answered(loaded(path, replace(OPTIONS, translation_scale="none")))
    assert not is_without_a_search(answer) and answer.position is None


def saved(path: Path) -> None:
    graph = drawn(False)
    online = OnlineEstimator(OPTIONS)
    Feed(graph, online).until(30)
    online.tick()
    online.save(path)


@pytest.mark.parametrize("values", [np.zeros((3, 3)), np.full(30, 10**12), np.arange(30)[::-1], np.zeros(30)])
def test_a_file_whose_components_are_none_is_refused(values: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    saved(path)
    state_file.write(path, state_file.read(path) | {"component": values})
    with pytest.raises(state_file.StateFileError, match="inconsistent"):
        loaded(path)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        *((f"labels_{name}", np.zeros((3, 3))) for name in ("trusted", "noise", "calibration", "places", "pose_noise")),
        ("labels_trusted", np.full(100, 2.0)),
        ("labels_noise", np.full(10, np.nan)),
        ("labels_noise", np.full(10, -1.0)),
        ("labels_noise", np.zeros(10)),
        ("labels_noise", np.ones(3)),
        ("labels_calibration", np.full(6, np.inf)),
        ("labels_bias_axis", np.zeros(3)),
        ("labels_bias_axis", np.full(3, np.nan)),
        ("labels_pose_noise", np.full(7, -1.0)),
        ("labels_search", np.zeros(2)),
    ],
)
def test_labels_that_are_none_are_done_without(name: str, values: np.ndarray, tmp_path: Path) -> None:
    """The map is worth more than the time of a search."""
    path = tmp_path / "state.npz"
    saved(path)
    assert is_without_a_search(answered(loaded(path)))
    state_file.write(path, state_file.read(path) | {name: values})
    assert not is_without_a_search(answered(loaded(path)))


@pytest.mark.parametrize("bias", [np.zeros(0), np.array([0.001, -0.002, 0.0005])])
def test_a_bias_that_version_6_kept_is_a_calibration(bias: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    saved(path)
    arrays = state_file.read(path)
    header = json.loads(arrays["header"].tobytes()) | {"format_version": 6}
    del arrays["labels_calibration"]
    header_bytes = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    state_file.write(path, arrays | {"labels_bias": bias, "header": header_bytes})
    online = loaded(path)
    assert is_without_a_search(answered(online))
    online.save(path)
    kept = state_file.read(path)["labels_calibration"]
    np.testing.assert_array_equal(kept[:3], bias)
    assert not kept[3:].any()


def test_a_file_that_does_not_say_about_which_axis_a_bias_is(tmp_path: Path) -> None:
    """As this version wrote them before; the bias may be about any axis."""
    path = tmp_path / "state.npz"
    saved(path)
    arrays = state_file.read(path)
    assert arrays.pop("labels_bias_axis").shape == (0,)
    state_file.write(path, arrays | {"labels_calibration": np.array([0.001, -0.002, 0.0005, 0, 0, 0])})
    online = loaded(path)
    assert is_without_a_search(answered(online))
    online.save(path)
    assert state_file.read(path)["labels_bias_axis"].shape == (0,)
    assert state_file.read(path)["labels_calibration"].shape == (6,)
