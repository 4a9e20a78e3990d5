"""Corridors at right angles: closures err along them, and repeat a false turn of the map exactly between the walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.plane_paths import walk_along
from rotavg_ros.metrics.positions import position_errors
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import ViewGraph

from .test_even_shifts import of_camera
from .test_map_turns import reversed_closures

# Crossings along each side, metres between them and between keyframes, and corridors that are walked.
CROSSINGS, BLOCK_M, STEP_M, WALKED = 3, 25.0, 1.5, 30
# Standard deviations: degrees about the vertical; metres ahead and sideways.
ODOMETRY = 0.25, 0.03, 0.015
CLOSURE = 0.3, 1.2, 0.03
FALSE = 0.3, 0.1, 0.03
# Keyframes between both ends of a closure at least; how far apart those are that see the same place, or another one.
PASSED, NEAR_M, FAR_M = 30, 1.5, 4.0
GOOD, WRONG = 100, 25


@dataclass(frozen=True)
class Walk:
    """N keyframes.

    Attributes:
        graph: the view-graph.
        position: ``(N, 3)`` metres.
        is_false: ``(E,)`` bool.
    """

    graph: ViewGraph
    position: np.ndarray
    is_false: np.ndarray


def yaw(angle: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(np.multiply.outer(angle, [0.0, 0.0, 1.0]))


def crossings(rng: np.random.Generator) -> np.ndarray:
    """``(n, 2)`` metres: no corridor is left backwards."""
    at, ahead, visited = np.zeros(2, dtype=int), 0, [np.zeros(2, dtype=int)]
    moves = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    for _ in range(WALKED):
        ways = [way % 4 for way in (ahead - 1, ahead, ahead + 1)]
        ahead = int(rng.choice([way for way in ways if ((at + moves[way] >= 0) & (at + moves[way] < CROSSINGS)).all()]))
        at = at + moves[ahead]
        visited.append(at)
    return np.stack(visited) * BLOCK_M


def seen_again(rng: np.random.Generator, place: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """``(GOOD, 2)`` pairs of keyframes that are near each other, with the same heading, the older first; in runs."""
    pairs = KDTree(place).query_pairs(NEAR_M, output_type="ndarray")
    turn = np.abs((heading[pairs[:, 0]] - heading[pairs[:, 1]] + np.pi) % (2 * np.pi) - np.pi)
    pairs = pairs[(np.diff(pairs, axis=1)[:, 0] > PASSED) & (turn < 0.3)]
    seen, chosen = set(map(tuple, pairs.tolist())), list[tuple[int, int]]()
    for older, newer in rng.permutation(pairs).tolist():
        run = [(older + step, newer + step) for step in range(int(rng.integers(3, 8)))]
        chosen += [pair for pair in run if pair in seen and pair not in chosen]
        if len(chosen) >= GOOD:
            break
    return np.array(chosen[:GOOD])


def mistaken(
    rng: np.random.Generator, position: np.ndarray, world_from_body: Rotation
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs ``(WRONG, 2)`` in runs of 3 to 6, and their false turns ``(WRONG, 4)`` and ways, from older to newer.

    The newer place is seen as if it were nearly where the older one is, and so are those after it: by one turn of the
    map, and one shift.
    """
    pairs: list[tuple[int, int]] = []
    turns, ways = [], []
    while len(pairs) < WRONG:
        older, newer = np.sort(rng.integers(0, len(position), 2))
        if newer - older < PASSED or np.linalg.norm(position[older] - position[newer]) < FAR_M:
            continue
        seen = world_from_body[older] * yaw(rng.normal(0, 0.1))
        moved = seen * world_from_body[newer].inv()
        there = position[older] + world_from_body[older].apply(np.append(rng.normal(0, 0.4, 2), 0.0))
        for step in range(min(int(rng.integers(3, 7)), WRONG - len(pairs), len(position) - newer)):
            back = world_from_body[older + step].inv()
            way = back.apply(there + moved.apply(position[newer + step] - position[newer]) - position[older + step])
            if np.linalg.norm(way) > FAR_M:  # the map is turned so that both walk apart
                break
            pairs.append((older + step, newer + step))
            turns.append((back * moved * world_from_body[newer + step]).as_quat())
            ways.append(way)
    return np.array(pairs), np.stack(turns), np.stack(ways)


def walk(seed: int) -> Walk:
    rng = np.random.default_rng(seed)
    corners = crossings(rng)
    length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    place = walk_along(corners, np.arange(0.0, length, STEP_M))
    ahead = np.diff(place, axis=0, append=2 * place[-1:] - place[-2:-1])
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    position, world_from_body = np.pad(place, ((0, 0), (0, 1))), yaw(heading)
    steps = np.stack((np.arange(len(place) - 1), np.arange(1, len(place))), axis=1)
    right = np.concatenate((steps, seen_again(rng, place, heading)))
    wrong, wrong_turn, wrong_way = mistaken(rng, position, world_from_body)
    older, newer = right.T
    turn = (world_from_body[older].inv() * world_from_body[newer]).as_quat()
    way = world_from_body[older].inv().apply(position[newer] - position[older])
    source, target = np.concatenate((right, wrong)).T
    turn, way = np.concatenate((turn, wrong_turn)), np.concatenate((way, wrong_way))
    sigma = np.repeat([ODOMETRY, CLOSURE, FALSE], [len(steps), len(right) - len(steps), len(wrong)], axis=0)
    error = sigma * rng.normal(size=(len(source), 3))
    seen = Rotation.from_quat(turn)
    way += seen.apply(np.pad(error[:, 1:], ((0, 0), (0, 1))))
    graph = ViewGraph.create(
        source,
        target,
        (seen * yaw(np.radians(error[:, 0]))).inv().as_quat(),
        num_nodes=len(place),
        kind=(np.arange(len(source)) >= len(steps)).astype(np.int64),
        translation=way,
    )
    return Walk(graph, position, np.arange(len(source)) >= len(right))


@pytest.mark.parametrize("seed", [66, *(pytest.param(seed, marks=pytest.mark.large) for seed in (70, 118))])
def test_runs_that_agree_between_the_walls_are_no_slip(seed: int) -> None:
    """A part that only false closures lead to, by turns near a right angle: with a slip, a run would be right.

    That the run repeats one turn of the map to centimetres between the walls, as exactly as good closures tell, is what
    speaks for it.
    """
    run = walk(seed)
    solution = solve(run.graph)
    odometry = run.graph.is_odometry
    assert solution.position is not None
    assert float(solution.outlier_score[odometry].max()) < 0.5
    assert float(solution.outlier_score[run.is_false].min()) > 0.5
    assert np.sqrt((position_errors(solution.position.numpy(), run.position) ** 2).mean()) < 1.0


@pytest.mark.large
def test_ends_and_the_bodys_axes_do_not_matter() -> None:
    """The shape of errors is that in the axes of the body at the older end, whatever these are called."""
    run = walk(66)
    graphs = run.graph, of_camera(run.graph), reversed_closures(run.graph, np.random.default_rng(0))
    first, *others = (solve(graph) for graph in graphs)
    assert first.position is not None
    for other in others:
        np.testing.assert_array_equal(first.outlier_score > 0.5, other.outlier_score > 0.5)
        assert other.position is not None
        assert position_errors(other.position.numpy(), first.position.numpy()).max() < 0.05
