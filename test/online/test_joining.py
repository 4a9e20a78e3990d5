"""Closures join what was apart: that tick takes no search, which follows beside the next answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import rotations, solve
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.evaluation.live.feed import Feed
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.online import Answer, EstimatorOptions, OnlineEstimator
from rotavg_ros.view_graph import ViewGraph

OPTIONS = EstimatorOptions(keyframe_source="edges", gauge="identity")


def restarted(graph: ViewGraph, node: int) -> tuple[ViewGraph, ViewGraph]:
    """The graph without what joins nodes before and after, and the closures that do."""
    before, after = (edge < node for edge in (graph.source, graph.target))
    return graph.select_edges(before == after), graph.select_edges((before != after) & ~graph.is_odometry)


def error_deg(case: DrawnGraph, graph: ViewGraph, answer: Answer) -> float:
    at = torch.from_numpy(answer.keyframe_id.astype(np.int64))
    found = rotations.inverse(torch.from_numpy(answer.world_from_body.copy()))
    truth = torch.from_numpy(case.body_from_world)[at]
    return float(np.degrees(orientation_errors(found, truth, graph.components()).numpy().mean()))


@pytest.mark.parametrize(
    ("kind", "with_places"),
    [
        ("building: 30 % random", False),
        ("hills: 30 % grouped", True),
        pytest.param("building: 30 % random", True, marks=pytest.mark.large),
        pytest.param("hills: 30 % grouped", False, marks=pytest.mark.large),
    ],
)
def test_a_robot_that_was_switched_off_and_on_is_joined_at_once(kind: str, with_places: bool) -> None:
    case = next(one for one in KINDS if one.name == kind).drawn(1)
    graph = replace(case.graph, translation=torch.from_numpy(case.edge_translation) if with_places else None)
    half = graph.num_nodes // 2
    own, joints = restarted(graph, half)
    online = OnlineEstimator(OPTIONS)
    feed, joining = Feed(own, online), Feed(joints, online)
    feed.until(half)
    online.tick()
    feed.until(half + 60)
    apart = online.tick()
    assert apart is not None and apart.num_components == 2
    joining.until(half + 60)
    joined = online.tick()
    assert joined is not None and joined.num_components == 1
    assert set(joined.stage_seconds) == {"update"} and not joined.was_cold
    now = online.snapshot().graph
    cold = solve(now, profile="slam")
    assert ((cold.outlier_score.numpy() > 0.5) != joined.outlier).sum() <= 1
    whole = replace(joined, world_from_body=cold.world_from_body.numpy())
    assert error_deg(case, now, joined) < 1.2 * error_deg(case, now, whole) + 0.1
    # The older part has not turned.
    np.testing.assert_allclose(joined.world_from_body[0], apart.world_from_body[0], atol=1e-12)
    # Which of the joints are good is gone into beside the next answers.
    assert is_due(online)


def is_due(online: OnlineEstimator) -> bool:
    memory = online._content.memory
    return memory.is_due or memory.ahead is not None


def test_the_search_that_a_join_asks_for_outlives_the_process(tmp_path: Path) -> None:
    """Saved before the tick that joins, after it, and while the search is under way."""
    case = next(one for one in KINDS if one.name == "building: 30 % random").drawn(1)
    half = case.graph.num_nodes // 2
    own, joints = restarted(case.graph, half)
    online, path = OnlineEstimator(OPTIONS), tmp_path / "state.npz"
    feed = Feed(own, online)
    feed.until(half + 55)
    online.tick()
    assert not is_due(online)

    def again() -> OnlineEstimator:
        online.save(path)
        other = OnlineEstimator(OPTIONS)
        other.load(path)
        answer = other.tick()
        assert answer is not None and set(answer.stage_seconds) == {"update"}
        return other

    assert not is_due(again())
    Feed(joints, online).until(half + 55)
    assert is_due(again())
    online.tick()
    assert is_due(online) and is_due(again())
    feed.until(half + 60)
    online.tick()
    online.go_on(work=1.0)
    assert online._content.memory.ahead is not None and is_due(again())


def test_without_labels_it_is_a_solve_from_nothing() -> None:
    """By a method that remembers nothing."""
    case = next(one for one in KINDS if one.name == "building: 15 closures").drawn(1)
    half = case.graph.num_nodes // 2
    own, joints = restarted(case.graph, half)
    online = OnlineEstimator(replace(OPTIONS, method="neurora~tails"))
    Feed(own, online).until(case.graph.num_nodes)
    assert online.tick() is not None
    Feed(joints, online).until(case.graph.num_nodes)
    answer = online.tick()
    assert answer is not None and answer.num_components == 1 and answer.was_cold
