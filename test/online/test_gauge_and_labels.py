"""What stays where it is in the answers: the gauge, the current orientation, labels of edges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.errors import UserError
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeLabel

from .drives import OPTIONS, closure, drive, feed, final, make


def test_current_orientation_is_the_last_corrected_keyframe_then_odometry(solver):
    turn = Rotation.from_rotvec([0.1, 0.2, 0.3])
    run, estimator = drive(), make(lambda graph, **options: turned_after_the_first(solver(graph, **options), turn))
    assert estimator.current_orientation("r") is None and estimator.world_from_odometry("r") is None
    feed(estimator, run, stop=2)
    np.testing.assert_allclose(estimator.current_orientation("r"), run.odometry[1].as_quat(canonical=True), atol=1e-12)
    feed(estimator, run, start=2, stop=20)
    np.testing.assert_allclose(
        final(estimator).world_from_body[1:], (turn * run.odometry[3:20:3]).as_quat(canonical=True), atol=1e-12
    )
    feed(estimator, run, start=20)
    expected = turn * run.odometry[39]
    np.testing.assert_allclose(estimator.current_orientation("r"), expected.as_quat(canonical=True), atol=1e-12)
    np.testing.assert_allclose(estimator.world_from_odometry("r"), turn.as_quat(canonical=True), atol=1e-12)


def turned_after_the_first(solution: Any, turn: Rotation) -> Any:
    """The solution with every world_from_body but the first turned in the first one's world."""
    body_from_world = Rotation.from_quat(solution.body_from_world.numpy())
    world_from_first = drive().odometry[0]  # the gauge that the estimator will give to the solver's identity
    turned = body_from_world * world_from_first.inv() * turn.inv() * world_from_first
    kept_first = torch.from_numpy(np.vstack(([0, 0, 0, 1.0], turned[1:].as_quat())))
    return replace(solution, body_from_world=kept_first)


@pytest.mark.parametrize("gauge", ["odometry", "identity"])
def test_the_first_keyframe_never_moves_and_orientation_fits_from_the_start(solver, gauge):
    run, estimator = drive(drift_deg=1), make(solver, replace(OPTIONS, gauge=gauge))
    feed(estimator, run, stop=1)
    first = run.odometry[0].as_quat(canonical=True) if gauge == "odometry" else np.array([0, 0, 0, 1.0])
    np.testing.assert_allclose(estimator.current_orientation("r"), first, atol=1e-12)
    for step in range(1, 40, 5):
        feed(estimator, run, start=step, stop=step + 5)
        if step > 20:
            estimator.add_edge(closure(run, step, 0, step))
        np.testing.assert_allclose(estimator.tick().world_from_body[0], first, atol=1e-12)


def test_when_components_join_the_older_keeps_its_gauge_and_a_rejected_edge_leaves_both_where_they_are(solver):
    one, two = drive(seed=1), drive(seed=2)
    estimator = make(solver)
    feed(estimator, one, "one")
    feed(estimator, two, "two")
    apart = final(estimator)
    assert apart.num_components == 2 and apart.robots == ("one", "two")
    np.testing.assert_allclose(apart.world_from_body[14], two.odometry[0].as_quat(canonical=True), atol=1e-12)
    bridge = Rotation.from_rotvec([0.3, -0.2, 0.1])
    edge = EdgeMeasurement(8, KeyframeReference("two", 3), KeyframeReference("one", 5), bridge.as_quat())
    estimator.add_edge(edge)
    joined = estimator.tick()
    assert joined.was_cold and joined.num_components == 1  # the old answer is no start
    np.testing.assert_allclose(joined.world_from_body[:14], apart.world_from_body[:14], atol=1e-12)
    expected = Rotation.from_quat(joined.world_from_body[5]) * bridge  # world_from_one ∘ one_from_two
    np.testing.assert_allclose(joined.world_from_body[17], expected.as_quat(canonical=True), atol=1e-12)
    assert estimator.label_edge("one", 8, EdgeLabel.REJECTED) == 0
    assert estimator.label_edge("two", 8, EdgeLabel.REJECTED) == 1
    split = final(estimator)
    assert split.num_components == 2
    assert split.outlier.tolist() == [False] * 26 + [True]
    np.testing.assert_allclose(split.world_from_body, joined.world_from_body, atol=1e-12)


def test_a_label_holds_for_waiting_edges_and_later_ones(solver):
    run, estimator = drive(), make(solver)
    late = EdgeMeasurement(4, KeyframeReference("r", 0), KeyframeReference("r", 13), (0, 0, 0, 1))
    estimator.add_edge(late)
    assert estimator.label_edge("r", 4, EdgeLabel.REJECTED) == 1
    assert estimator.label_edge("r", 5, EdgeLabel.REJECTED) == 0
    feed(estimator, run)
    estimator.add_edge(replace(late, target_from_source=(0, 0, 0.6, 0.8)))
    assert final(estimator).outlier.tolist() == [False] * 13 + [True, True]
    assert estimator.label_edge("r", 4, EdgeLabel.AUTOMATIC) == 2
    assert not final(estimator).outlier.any()


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_a_label_decides_whatever_the_threshold(solver, threshold):
    run, estimator = drive(), make(solver, replace(OPTIONS, outlier_threshold=threshold))
    feed(estimator, run)
    for edge_id, label in enumerate((EdgeLabel.REJECTED, EdgeLabel.ACCEPTED)):
        estimator.add_edge(closure(run, edge_id, 0, 30))
        assert estimator.label_edge("r", edge_id, label) == 1
    assert final(estimator).outlier.tolist() == [False] * 13 + [True, False]


def test_what_is_no_label_or_no_id_labels_nothing(solver, tmp_path):
    """A file with a label that does not exist could never be loaded."""
    run, online = drive(), make(solver)
    feed(online, run)
    online.add_edge(closure(run, 1, 0, 30))
    for label in (7, -1, "rejected"):
        with pytest.raises(UserError, match=r"label .*; 0 is automatic, 1 accepted, 2 rejected"):
            online.label_edge("r", 1, label)
    assert [online.label_edge("r", edge_id, EdgeLabel.REJECTED) for edge_id in (-1, 2**64, 1)] == [0, 0, 1]
    online.save(tmp_path / "state.npz")
    OnlineEstimator(OPTIONS, solver).load(tmp_path / "state.npz")
