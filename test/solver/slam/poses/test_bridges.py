"""Robots that closures alone join: what nothing contradicts is as likely false as closures are, no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.view_graph import EdgeLabel

LENGTH = 60


def two_robots(bridges: int, false: int, loops: int, planar: bool, seed: int) -> tuple[ViewGraph, np.ndarray]:
    """Two robots side by side, the first closures between them, some false, the others of the first one alone.

    Returns:
        the graph, and which of its closures are false.
    """
    random = np.random.default_rng(seed)
    axes = np.array([0, 0, 1]) if planar else np.ones(3)
    way = np.array([1, 1, 0]) if planar else np.ones(3)
    turns, places = [], []
    edges: list[tuple[int, int, Rotation, int, np.ndarray]] = []
    for robot in range(2):
        turn = Rotation.from_rotvec(np.outer(np.cumsum(random.normal(0, 0.3, LENGTH)), [0, 0, 1]))
        turn = turn if planar else turn * Rotation.from_rotvec(random.normal(0, 0.2, (LENGTH, 3)))
        steps = turn[:-1].apply(np.tile([0.5, 0, 0], (LENGTH - 1, 1)))
        place = np.cumsum(np.vstack(([[0, 3 * robot, 0]], steps)), axis=0)
        turns.append(turn)
        places.append(place)
        for at in range(LENGTH - 1):
            error = Rotation.from_rotvec(random.normal(0, np.radians(0.5), 3) * axes)
            step = turn[at].inv().apply(place[at + 1] - place[at]) + random.normal(0, 0.01, 3) * way
            node = robot * LENGTH + at
            edges.append((node, node + 1, turn[at].inv() * turn[at + 1] * error, 0, step))
    for number in range(bridges + loops):
        i, j = random.integers(LENGTH, size=2)
        other = int(number < bridges)
        if not other and abs(i - j) < 5:
            j = (i + LENGTH // 2) % LENGTH
        relative = turns[0][i].inv() * turns[other][j] * Rotation.from_rotvec(random.normal(0, 0.02, 3) * axes)
        shift = turns[0][i].inv().apply(places[other][j] - places[0][i]) + random.normal(0, 0.05, 3) * way
        if number < false:
            relative = relative * Rotation.from_rotvec([0, 0, random.uniform(1, 3)])
            shift = shift + random.normal(0, 8, 3) * way
        edges.append((i, other * LENGTH + j, relative, 1, shift))
    source, target, rotation, kind, translation = zip(*edges, strict=True)
    graph = ViewGraph.create(
        source,
        target,
        source_from_target=np.array([each.as_quat() for each in rotation]),
        kind=kind,
        translation=np.array(translation),
    )
    return graph, np.arange(bridges + loops) < false


def scores(graph: ViewGraph) -> np.ndarray:
    return solve(graph).outlier_score.numpy()[~graph.is_odometry.numpy()]


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in (1, 2))])
def test_a_closure_that_alone_joins_two_robots_is_as_likely_false_as_others_are(planar, seed):
    graph, _ = two_robots(1, 0, 10, planar, seed)
    found = scores(graph)
    assert (found[1:] < 0.05).all() and found[0] < 0.3
    # Where there are no others, nobody can tell.
    alone = scores(two_robots(1, 0, 0, planar, seed)[0])
    assert 0.1 < alone[0] < 0.7


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize(("bridges", "false", "loops"), [(2, 0, 0), (3, 1, 5), (10, 3, 0)])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in (1, 2))])
def test_bridges_that_agree_are_believed_and_the_others_are_not(planar, bridges, false, loops, seed):
    graph, is_false = two_robots(bridges, false, loops, planar, seed)
    np.testing.assert_array_equal(scores(graph) > 0.5, is_false)


def test_robots_of_which_only_one_moves():
    """A square of which corners turn and nothing moves, twice, joined once; and one that moves, and closes."""
    corners = [Rotation.from_euler("zx", [90 * corner, 20 * corner], degrees=True) for corner in range(4)]
    place = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    edges = []
    for robot in range(3):
        for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))[: 4 if robot == 0 else 3]:
            shift = corners[a].inv().apply(place[b] - place[a]) * (robot == 0)
            edges.append((4 * robot + a, 4 * robot + b, corners[a].inv() * corners[b], int(b == 0), shift))
    edges.append((5, 10, Rotation.random(random_state=1), 1, np.zeros(3)))
    source, target, rotation, kind, translation = zip(*edges, strict=True)
    quaternions = np.array([each.as_quat() for each in rotation])
    graph = ViewGraph.create(
        source, target, source_from_target=quaternions, kind=kind, translation=np.array(translation)
    )
    assert (scores(graph) < 0.5).all()


@pytest.mark.parametrize("with_places", [True, False])
def test_a_lone_bridge_repeats_no_other_closures_mistake(with_places: bool) -> None:
    """A user rejects a closure that fits. Nothing predicts the bridge: nobody knows it to be wrong by the same turn."""
    graph, _ = two_robots(1, 0, 4, False, 0)
    closures = np.flatnonzero(~graph.is_odometry.numpy())
    label = graph.label.clone()
    label[closures[2]] = int(EdgeLabel.REJECTED)
    labelled = replace(graph, label=label, translation=graph.translation if with_places else None)
    assert scores(labelled)[0] < 0.5
