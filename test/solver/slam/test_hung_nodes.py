"""Pose graphs with submaps as nodes of their own, with constraints to the keyframes that each was built of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.hung_nodes import hung
from rotavg_ros.solver.slam.links import with_links
from rotavg_ros.view_graph import ViewGraph

from .linked_keyframes import drawn, error_deg, poses

EVERY, LENGTH = 30, 60


def with_submaps(case: DrawnGraph) -> ViewGraph:
    """The graph with submaps instead of loop closures' older ends; the constraints within submaps are odometry's."""
    graph = replace(case.graph, translation=torch.from_numpy(case.edge_translation))
    orientation, position = poses(graph)
    count = graph.num_nodes
    first = np.arange(0, count, EVERY)
    submap = np.concatenate(
        [np.full(len(range(at, min(at + LENGTH, count))), number) for number, at in enumerate(first)]
    )
    keyframe = np.concatenate([np.arange(at, min(at + LENGTH, count)) for at in first])
    source = first[submap]
    turn = orientation[source].inv() * orientation[keyframe]
    shift = orientation[source].inv().apply(position[keyframe] - position[source])
    more = ViewGraph.create(
        count + submap, keyframe, source_from_target=turn.as_quat(), translation=shift, num_nodes=count + len(first)
    )
    columns = ("source", "target", "target_from_source", "kind", "precision", "label", "steps", "translation")
    both = {name: torch.cat((getattr(graph, name), getattr(more, name))) for name in columns}
    return replace(graph, num_nodes=count + len(first), **both)


def test_what_a_submap_was_built_of_says_nothing() -> None:
    """Taken for measurements, its constraints would seem to prove that odometry is exact."""
    case = drawn("hills: 30 % random")
    graph = with_submaps(case)
    many = len(range(0, case.graph.num_nodes, EVERY))
    assert len(hung(graph)) == many
    solution = solve(graph, profile="slam")
    alone = solve(replace(case.graph, translation=torch.from_numpy(case.edge_translation)), profile="slam")
    keyframes = replace(solution, body_from_world=solution.body_from_world[: case.graph.num_nodes])
    assert error_deg(case, keyframes) < 1.05 * error_deg(case, alone) + 0.02
    flagged = solution.outlier_score[: case.graph.num_edges] > 0.5
    np.testing.assert_array_equal(flagged, alone.outlier_score > 0.5)
    assert solution.position is not None and bool(torch.isfinite(torch.as_tensor(solution.position)).all())


def test_nodes_that_were_measured_do_not_hang() -> None:
    """A landmark that some keyframes see errs by itself."""
    case = drawn("hills: 30 % random")
    graph = with_submaps(case)
    rng, constraint = np.random.default_rng(0), graph.source >= case.graph.num_nodes
    noise = Rotation.from_rotvec(np.radians(3.0) * rng.normal(size=(int(constraint.sum()), 3)))
    stated = graph.target_from_source.clone()
    stated[constraint] = torch.from_numpy(
        (noise * Rotation.from_quat(stated[constraint].numpy())).as_quat(canonical=True)
    )
    assert len(with_links(replace(graph, target_from_source=stated))[1]) == 0


def test_ends_order_and_numbers_do_not_matter() -> None:
    case = drawn("hills: 30 % random")
    graph = with_submaps(case)
    rng = np.random.default_rng(0)
    order = rng.permutation(graph.num_edges)
    other = graph.reverse_edges(torch.from_numpy(rng.random(graph.num_edges) < 0.5)).select_edges(
        torch.from_numpy(order)
    )
    number = torch.from_numpy(rng.permutation(graph.num_nodes))
    other = replace(other, source=number[other.source], target=number[other.target])
    assert len(with_links(other)[1]) == len(with_links(graph)[1]) > 0
    answer, same = solve(graph, profile="slam"), solve(other, profile="slam")
    turned = replace(case, body_from_world=answer.body_from_world.numpy())
    assert error_deg(turned, replace(same, body_from_world=same.body_from_world[number])) < 0.15
    np.testing.assert_allclose(same.outlier_score, answer.outlier_score[order], atol=0.05)
