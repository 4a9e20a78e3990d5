"""Components of a graph: the answer of each is the one that it has when alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import Solution, ViewGraph, rotations, solve
from rotavg_ros.solver.sfm import refinement
from rotavg_ros.solver.sfm.step.problem import Problem
from rotavg_ros.solver.sfm.step.structure import Structure
from test.solver.graphs import as_quaternions, random_truth
from test.solver.sfm.test_sparse import anyhow


def uneven(seed: int, cameras: int, degree: int) -> ViewGraph:
    """Random pairs that state about which axes they are exact, as they are, but for a fifth of false ones."""
    rng, exact = np.random.default_rng(seed), anyhow(seed, cameras, degree, 0.0)[0]
    truth, number = random_truth(cameras, seed), exact.num_edges
    axes, deviation = Rotation.random(number, rng), 0.02 * np.exp(0.9 * rng.normal(size=(number, 3)))
    matrix = axes.as_matrix()
    noise = Rotation.from_rotvec(axes.apply(deviation * rng.normal(size=(number, 3))))
    relative = noise * truth[exact.target.numpy()] * truth[exact.source.numpy()].inv()
    is_false = rng.random((number, 1)) < 0.2
    stated = np.where(is_false, Rotation.random(number, rng).as_quat(), relative.as_quat())
    information = (matrix * deviation[:, None] ** -2) @ matrix.transpose(0, 2, 1)
    return ViewGraph.create(exact.source, exact.target, stated, information=information)


def beside(*graphs: ViewGraph) -> ViewGraph:
    first = np.cumsum([0, *(graph.num_nodes for graph in graphs)])
    ends = (
        torch.cat([getattr(graph, end) + int(at) for graph, at in zip(graphs, first, strict=False)])
        for end in ("source", "target")
    )
    stated = [graph.information for graph in graphs if graph.information is not None]
    information = torch.cat(stated) if stated else None
    measured = torch.cat([graph.target_from_source for graph in graphs])
    return ViewGraph.create(*ends, measured, num_nodes=int(first[-1]), information=information)


def furthest_deg(found: Solution, expected: Solution) -> float:
    """Largest angle between the orientations of the first component."""
    first = found.body_from_world[: len(expected.body_from_world)]
    return float(torch.rad2deg(rotations.angle_between(first, expected.body_from_world)).max())


@pytest.mark.parametrize(
    ("graph", "others", "most_deg"),
    [
        (anyhow(0, 40, 6, 0.3)[0], [anyhow(3, 50, 45, 0.5)[0]], 1e-6),
        (anyhow(1, 60, 8, 0.3)[0], [anyhow(3, 50, 45, 0.5)[0], anyhow(4, 3, 2, 0.0)[0]], 1e-6),
        (anyhow(2, 50, 20, 0.3)[0], [anyhow(5, 60, 5, 0.2)[0], anyhow(3, 50, 45, 0.5)[0]], 1e-5),
        (uneven(0, 40, 6), [uneven(3, 50, 45)], 1e-4),
        (uneven(1, 50, 16), [uneven(4, 60, 6)], 1e-4),
    ],
    ids=["sparse", "sparse, of three", "dense", "sparse, stated shapes", "dense, stated shapes"],
)
def test_answers_do_not_depend_on_other_components(graph: ViewGraph, others: list[ViewGraph], most_deg: float) -> None:
    """To rounding, which is that of single precision where cameras have many edges."""
    alone, together = solve(graph, profile="sfm"), solve(beside(graph, *others), profile="sfm")
    assert furthest_deg(together, alone) < most_deg
    scores = together.outlier_score[: graph.num_edges]
    torch.testing.assert_close(scores, alone.outlier_score, atol=1e-4, rtol=0)


def test_each_component_has_its_own_number_of_steps() -> None:
    """One begins at its solution, the other far away; few steps are allowed."""
    (near, truth), (far, _) = anyhow(0, 40, 20, 0.0), anyhow(1, 40, 8, 0.4)
    priors = refinement.PRIORS
    problem = Problem(beside(near, far), Structure.of(beside(near, far)), priors)
    start = torch.cat((as_quaternions(truth), as_quaternions(random_truth(40, 9))))
    weight = torch.ones(problem.graph.num_edges)
    found, steps = refinement.coarse_steps(problem, start, weight)
    for part, graph in ((slice(0, 40), near), (slice(40, 80), far)):
        alone = Problem(graph, Structure.of(graph), priors)
        expected, number = refinement.coarse_steps(alone, start[part], torch.ones(graph.num_edges))
        assert steps[problem.component[part.start]] == number
        assert float(rotations.angle_between(found[part], expected).max()) < 1e-6
    assert len(set(steps.tolist())) == 2
    most = torch.tensor([3, 1])
    weights = refinement.EdgeWeights(weight, weight)
    settled = refinement.shaped_steps(problem, found, weights, most)
    assert bool((settled.steps <= most).all())


def test_nodes_without_edges_change_nothing() -> None:
    graph, _ = anyhow(2, 50, 8, 0.3)
    alone = solve(graph, profile="sfm")
    loners = ViewGraph.create(graph.source, graph.target, graph.target_from_source, num_nodes=55)
    assert furthest_deg(solve(loners, profile="sfm"), alone) < 1e-6
