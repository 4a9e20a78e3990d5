from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.evaluation.live.node_answer import NodeAnswer
from rotavg_ros.evaluation.live.picture import draw
from rotavg_ros.evaluation.live.played_run import PlayedRun, edge_is_false, judge

KEYFRAMES = slice(0, None, 3)


@pytest.fixture(scope="module")
def simulated() -> SimulatedRun:
    config = SlamSimulationConfig(world=World.CITY, dimensions=3, num_keyframes=600, terrain_tilt_deg=5.0)
    return simulate_slam_graph(config, np.random.default_rng(0))


def played(run: SimulatedRun, *, by_id: bool = False, truth: bool = True) -> PlayedRun:
    graph_file = run.to_graph_file()
    return PlayedRun(
        ids=graph_file.node_ids if by_id else None,
        stamps_ns=run.stamps_ns,
        odometry_world_from_body=run.odometry_world_from_body,
        odometry_position=run.odometry_position,
        true_world_from_body=run.world_from_body if truth else None,
        true_position=run.position if truth else None,
        edge_is_false=edge_is_false(run.graph, graph_file.body_from_world_gt if truth else None),
    )


def perfect_answer(run: SimulatedRun) -> NodeAnswer:
    """The truth in another gauge, at every third pose, and a verdict on the closures between them."""
    graph = run.graph
    source, target = graph.source.numpy(), graph.target.numpy()
    edges = np.flatnonzero((source % 3 == 0) & (target % 3 == 0))
    gauge = Rotation.from_rotvec([0.3, -0.2, 1.0])
    ids = np.arange(600)[KEYFRAMES]
    return NodeAnswer(
        keyframe_ids=ids.astype(np.uint64),
        stamps_ns=run.stamps_ns[KEYFRAMES] + 1000,
        world_from_body=(gauge * Rotation.from_quat(run.world_from_body[KEYFRAMES])).as_quat(),
        component=np.zeros(len(ids), dtype=np.int64),
        edge_ids=edges.astype(np.uint64),
        source_ids=source[edges].astype(np.uint64),
        target_ids=target[edges].astype(np.uint64),
        kind=graph.kind.numpy()[edges],
        score=run.closure_is_false[edges].astype(float),
        is_outlier=run.closure_is_false[edges],
    )


@pytest.mark.parametrize("by_id", [False, True])
def test_a_perfect_answer(simulated: SimulatedRun, by_id: bool) -> None:
    is_closure = ~simulated.graph.is_odometry.numpy()
    report = judge(perfect_answer(simulated), played(simulated, by_id=by_id), is_closure)
    assert report.knows_errors
    assert np.nanmax(report.corrected_error) < 1e-6
    assert np.degrees(report.odometry_error.mean()) > 0.5
    assert report.verdicts is not None
    assert report.verdicts.precision == 1
    # False closures that the node never heard of count as missed.
    assert report.verdicts.true_positives == report.closure_flagged.sum()
    assert report.verdicts.true_positives + report.verdicts.false_negatives == simulated.closure_is_false.sum()
    np.testing.assert_array_equal(report.true_position, simulated.position[KEYFRAMES])
    # Odometry's steps along true orientations are off by the noise of the steps' lengths only.
    off = np.linalg.norm(report.corrected_position - report.true_position, axis=1)
    drift = np.linalg.norm(report.odometry_position - report.true_position, axis=1)
    assert off.max() < 2
    assert off.max() < drift.max() / 2


def test_a_closure_is_false_by_its_place_as_well(simulated: SimulatedRun) -> None:
    graph_file = simulated.to_graph_file()
    graph, truth = simulated.graph, graph_file.body_from_world_gt
    turn = Rotation.from_quat(simulated.world_from_body)
    source, target = graph.source.numpy(), graph.target.numpy()
    translation = turn[source].inv().apply(simulated.position[target] - simulated.position[source])
    by_rotation = edge_is_false(graph, truth)
    good, turned = (np.flatnonzero(by_rotation == value) for value in (0, 1))
    translation[good[0]] += [0.0, 3.0, 0.0]
    translation[good[1]] += [0.0, 1.0, 0.0]
    translation[good[2]] = translation[turned[0]] = np.nan
    position = simulated.position.copy()
    position[target[good[3]]] = np.nan
    placed = replace(graph, translation=torch.from_numpy(translation))
    judged = edge_is_false(placed, truth, position)
    assert judged[good[:4]].tolist()[:3] == [1, 0, 0] and np.isnan(judged[good[3]])
    assert (judged[turned] == 1).all()
    np.testing.assert_array_equal(edge_is_false(graph, truth, position), by_rotation)
    np.testing.assert_array_equal(edge_is_false(placed, truth), by_rotation)


def test_closures_connect_the_right_keyframes(simulated: SimulatedRun) -> None:
    is_closure = ~simulated.graph.is_odometry.numpy()
    report = judge(perfect_answer(simulated), played(simulated), is_closure)
    ends = report.true_position[report.closure_ends[report.closure_is_false == 0]]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() <= SlamSimulationConfig().closure_radius_m


def test_without_truth_nothing_is_claimed(simulated: SimulatedRun, tmp_path: Path) -> None:
    is_closure = ~simulated.graph.is_odometry.numpy()
    report = judge(perfect_answer(simulated), played(simulated, truth=False), is_closure)
    assert not report.knows_errors
    assert report.verdicts is None
    assert np.isfinite(report.corrected_position).all()
    np.testing.assert_allclose(report.corrected_position[0], report.odometry_position[0])
    draw(report, tmp_path / "picture.png", "no$_$truth.g2o")
    with Image.open(tmp_path / "picture.png") as image:
        assert image.size == (2100, 1200)


def test_the_picture(simulated: SimulatedRun, tmp_path: Path) -> None:
    report = judge(perfect_answer(simulated), played(simulated), ~simulated.graph.is_odometry.numpy())
    draw(report, tmp_path / "picture.png", "a title")
    with Image.open(tmp_path / "picture.png") as image:
        assert image.size == (2100, 1200)
        assert len(image.convert("RGB").getcolors(1 << 24)) > 100


@pytest.mark.parametrize(("truth", "closures", "panels"), [(True, True, 3), (True, False, 2), (False, False, 1)])
def test_the_picture_has_no_empty_panel(
    simulated: SimulatedRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    truth: bool,
    closures: bool,
    panels: int,
) -> None:
    answer, figures = perfect_answer(simulated), []
    if not closures:
        none = {name: getattr(answer, name)[:0] for name in ("edge_ids", "source_ids", "target_ids", "kind")}
        answer = replace(answer, **none, score=answer.score[:0], is_outlier=answer.is_outlier[:0])
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw(judge(answer, played(simulated, truth=truth), ~simulated.graph.is_odometry.numpy()), tmp_path / "a.png", "")
    (figure,) = figures
    assert len(figure.axes) == panels
    assert all(axes.has_data() for axes in figure.axes)
