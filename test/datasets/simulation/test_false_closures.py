from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.simulation.false_closures import FalseClosureError, insert_slips, replace_closures
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.slip_places import CROSSED, LOCATABLE, SlipRule, crossing_difference, slip_places
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.view_graph import EdgeKind


def clean_graph(planar: bool = True, seed: int = 0, closures_per_keyframe: float = 1.0) -> GraphFile:
    config = SlamSimulationConfig(
        world=World.GRID if planar else World.SPHERE,
        dimensions=2 if planar else 3,
        num_keyframes=800,
        false_share=0,
        closures_per_keyframe=closures_per_keyframe,
        odometry_noise_deg=0.2,
        closure_noise_deg=0.5,
    )
    return simulate_slam_graph(config, np.random.default_rng(seed)).to_graph_file()


@given(share=st.floats(0, 1), grouped=st.booleans(), planar=st.booleans(), seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_only_the_asked_for_share_of_closures_changes(share: float, grouped: bool, planar: bool, seed: int) -> None:
    clean = clean_graph(planar)
    rng = np.random.default_rng(seed)
    spoiled = replace_closures(clean, clean.body_from_world_gt, share, rng, grouped=grouped)
    closures = clean.graph.kind.numpy() == EdgeKind.LOOP_CLOSURE
    assert spoiled.spoiled.sum() == round(share * closures.sum())
    assert not spoiled.spoiled[~closures].any()
    before, after = clean.graph.target_from_source.numpy(), spoiled.graph_file.graph.target_from_source.numpy()
    np.testing.assert_array_equal(before[~spoiled.spoiled], after[~spoiled.spoiled])
    assert not spoiled.is_outlier[~spoiled.spoiled].any()
    if planar:
        assert np.abs(after[:, :2]).max() < 1e-12


def test_random_ones_are_uniform() -> None:
    planar, spatial = clean_graph(True), clean_graph(False)
    rng = np.random.default_rng(1)
    yaw = replace_closures(planar, planar.body_from_world_gt, 1.0, rng)
    assert yaw.noise[yaw.spoiled].mean() == pytest.approx(np.pi / 2, rel=0.1)
    turn = replace_closures(spatial, spatial.body_from_world_gt, 1.0, rng)
    # The mean angle of uniform rotations is π/2 + 2/π.
    assert turn.noise[turn.spoiled].mean() == pytest.approx(np.pi / 2 + 2 / np.pi, rel=0.05)


def test_runs_agree_in_the_world_frame() -> None:
    clean = clean_graph(False)
    spoiled = replace_closures(clean, clean.body_from_world_gt, 0.3, np.random.default_rng(2), grouped=True)
    graph = spoiled.graph_file.graph
    chosen = np.flatnonzero(spoiled.spoiled)
    source, target = graph.source.numpy()[chosen], graph.target.numpy()[chosen]
    newer_from_older = graph.target_from_source.numpy()[chosen].copy()
    newer_from_older[source > target, :3] *= -1
    world_from_body = Rotation.from_quat(clean.body_from_world_gt).inv()
    wrong = (
        world_from_body[np.maximum(source, target)]
        * Rotation.from_quat(newer_from_older)
        * world_from_body[np.minimum(source, target)].inv()
    ).as_rotvec()
    same = np.linalg.norm(wrong[:, None] - wrong[None], axis=2) < 1e-6
    sizes = same.sum(axis=1)
    assert sizes.max() <= 12
    assert np.count_nonzero(sizes < 4) < 4, "at most one run is cut short by the share"
    # A run is a run: its members follow each other among the closures.
    rank = np.cumsum(graph.kind.numpy() == EdgeKind.LOOP_CLOSURE)[chosen]
    for members in same:
        assert np.ptp(rank[members]) == members.sum() - 1


def test_slips_can_be_located() -> None:
    clean = clean_graph(True, closures_per_keyframe=1.5)
    spoiled = insert_slips(clean, clean.body_from_world_gt, 0.01, np.random.default_rng(3))
    graph = clean.graph
    assert spoiled.spoiled.sum() == 8
    angle = np.degrees(spoiled.noise[spoiled.spoiled])
    assert angle.min() > 19
    assert angle.max() < 61
    source, target, kind = graph.source.numpy(), graph.target.numpy(), graph.kind.numpy()
    closures = kind == EdgeKind.LOOP_CLOSURE
    ends = np.unique(np.concatenate((source[closures], target[closures])))
    for edge in np.flatnonzero(spoiled.spoiled):
        assert kind[edge] == EdgeKind.ODOMETRY
        step = min(source[edge], target[edge])
        before, after = ends[ends <= step].max(), ends[ends > step].min()
        assert after - before <= 3
        low, high = np.minimum(source, target)[closures], np.maximum(source, target)[closures]
        assert ((low <= step) & (high > step)).sum() >= 2


@given(seed=st.integers(0, 10_000), num_nodes=st.integers(3, 24), density=st.floats(0.1, 1.5))
@settings(max_examples=60, deadline=None)
def test_a_place_qualifies_if_no_other_is_spanned_by_nearly_the_same(seed: int, num_nodes: int, density: float) -> None:
    """Against sets of closures, compared one by one."""
    rng = np.random.default_rng(seed)
    ends = np.sort([rng.permutation(num_nodes)[:2] for _ in range(1 + round(density * num_nodes))], axis=1)
    first, last = ends.T
    spanning = [{c for c, (low, high) in enumerate(ends) if low <= k < high} for k in range(num_nodes - 1)]
    literal = slip_places(first, last, num_nodes, CROSSED)
    rule = SlipRule(min_across=3, min_difference=2)
    found = slip_places(first, last, num_nodes, rule)
    assert not found[-1]
    for k, one in enumerate(spanning):
        assert crossing_difference(first, last, num_nodes, k).tolist() == [len(one ^ other) for other in spanning]
        far = [other for j, other in enumerate(spanning) if abs(j - k) > rule.max_stretch]
        ends_before = [end for end in ends.ravel() if end <= k]
        ends_after = [end for end in ends.ravel() if end > k]
        is_short = bool(ends_before and ends_after) and min(ends_after) - max(ends_before) <= rule.max_stretch
        assert literal[k] == (is_short and len(one) >= 2)
        assert found[k] == (is_short and len(one) >= 3 and all(len(one ^ other) >= 2 for other in far))


def test_there_and_back_no_place_can_be_told_from_its_mirror_image() -> None:
    """A slip on the way out and one on the way back are the same to all closures."""
    first = np.arange(20)
    last = 40 - first
    assert slip_places(first, last, 41, CROSSED)[1:-2].all()
    assert not slip_places(first, last, 41, LOCATABLE).any()
    # Closures from the turning point to where the robot came from tell the two ways apart.
    first, last = np.concatenate((first, first)), np.concatenate((last, np.full(20, 20)))
    assert slip_places(first, last, 41, LOCATABLE)[5:16].all()


def test_no_slips_where_nothing_could_locate_them() -> None:
    clean = clean_graph(True, closures_per_keyframe=0.005)
    assert not insert_slips(clean, clean.body_from_world_gt, 0.1, np.random.default_rng(4)).spoiled.any()


def test_bad_requests() -> None:
    clean = clean_graph()
    rng = np.random.default_rng(5)
    with pytest.raises(FalseClosureError, match="share"):
        replace_closures(clean, clean.body_from_world_gt, 1.5, rng)
    with pytest.raises(FalseClosureError, match="shape"):
        insert_slips(clean, clean.body_from_world_gt[:10], 0.1, rng)
    with pytest.raises(FalseClosureError, match="complete"):
        replace_closures(clean, np.full_like(clean.body_from_world_gt, np.nan), 0.1, rng)
