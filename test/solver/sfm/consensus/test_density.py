"""The density by which two answers are compared, and triangles."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.sfm.consensus.density import Density, Edges, fitted
from rotavg_ros.solver.sfm.consensus.search import CONSENSUS
from rotavg_ros.solver.sfm.cycles.triangles import Triangles
from rotavg_ros.view_graph import ViewGraph


def _graph(seed: int, num_nodes: int, false: float, noise_deg: float) -> tuple[Edges, Rotation, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = Rotation.random(num_nodes, random_state=seed)
    source, target = np.triu_indices(num_nodes, k=1)
    noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.standard_normal((len(source), 3)))
    measured = (truth[target] * truth[source].inv() * noise).as_quat()
    is_false = rng.random(len(source)) < false
    measured[is_false] = Rotation.random(int(is_false.sum()), random_state=seed + 1).as_quat()
    return Edges(num_nodes, source, target, measured.T.copy(), np.zeros(len(source), dtype=bool)), truth, is_false


def _triangles(edges: Edges, most: int = 10**6) -> Triangles:
    graph = ViewGraph.create(edges.source, edges.target, edges.measured.T, num_nodes=edges.num_nodes)
    return Triangles.of(graph, most)


def _contradicting(edges: Edges, rejected: np.ndarray, closing: float) -> float:
    one_group = torch.zeros(len(rejected), dtype=torch.int64)
    return float(_triangles(edges).contradicting(torch.from_numpy(rejected), one_group, 1, closing))


@settings(max_examples=20)
@given(st.integers(3, 9), st.integers(0, 2**16))
def test_triangles_are_those_of_the_graph(num_nodes: int, seed: int) -> None:
    edges, _, _ = _graph(seed, num_nodes, 0.5, 5.0)
    kept = np.random.default_rng(seed).permutation(len(edges.source))[: 2 * num_nodes]
    ends, measured = np.stack((edges.source, edges.target))[:, kept], edges.measured[:, kept]
    found = Triangles.of(ViewGraph.create(*ends, measured.T, num_nodes=num_nodes), 10**6)
    at = {(int(s), int(t)): number for number, (s, t) in enumerate(ends.T)}
    expected = {}
    for u, v, w in combinations(range(num_nodes), 3):
        if {(u, v), (v, w), (u, w)} <= at.keys():
            one, two, three = (Rotation.from_quat(measured[:, at[pair]]) for pair in ((u, v), (v, w), (u, w)))
            expected[at[u, v], at[v, w], at[u, w]] = (three.inv() * two * one).magnitude()
    assert {tuple(edge) for edge in found.edge.T.tolist()} == expected.keys()
    for edge, angle in zip(found.edge.T.tolist(), found.angle.tolist(), strict=True):
        assert angle == pytest.approx(expected[tuple(edge)], abs=1e-6)


def test_so_many_triangles_at_most() -> None:
    edges, _, _ = _graph(0, 40, 0.5, 5.0)
    assert len(_triangles(edges).angle) == 40 * 39 * 38 / 6
    assert 0 < len(_triangles(edges, 1000).angle) <= 1000


def test_edges_that_are_false_by_chance_contradict_nothing() -> None:
    """Random rotations close triangles now and then; those that agree close more of them."""
    closing = np.radians(1.0)
    by_chance = []
    for seed in range(10):
        edges, _, is_false = _graph(seed, 50, 0.5, 0.3)
        by_chance.append(_contradicting(edges, is_false, closing))
    assert max(by_chance) < CONSENSUS.contradicting
    edges, _, _ = _graph(0, 50, 0.0, 0.3)
    agreeing = np.isin(edges.source, range(10)) & np.isin(edges.target, range(10))
    assert _contradicting(edges, agreeing, closing) > CONSENSUS.contradicting


@pytest.mark.parametrize("chance", [(0.0, 0.0), (3.0, -4.0)])
def test_it_integrates_to_one(chance: tuple[float, float]) -> None:
    """Over all rotations that an edge could state, its ends turned by whatever the answer says."""
    stated = Rotation.random(200_000, random_state=0)
    predicted = Rotation.from_euler("z", 25, degrees=True)
    square = (predicted.inv() * stated).magnitude() ** 2
    shell = np.searchsorted(CONSENSUS.shells, stated.magnitude(), side="right") - 1
    density = Density(CONSENSUS, shell, np.radians(6.0))
    density.chance = np.array(chance)
    good, false = density.logs(square, np.full(len(square), predicted.magnitude()))
    # Its tails, the measure of large turns and the samples leave a few hundredths.
    assert np.exp(np.logaddexp(good, false)).mean() == pytest.approx(1.0, abs=0.05)
    assert np.exp(false).mean() + np.exp(good).mean() == pytest.approx(1.0, abs=0.05)


def test_the_truth_is_found_from_near_and_false_edges_are_told() -> None:
    edges, truth, is_false = _graph(3, 40, 0.4, 1.0)
    near = truth * Rotation.from_rotvec(0.2 * np.random.default_rng(0).standard_normal((40, 3)))
    found = fitted(edges, near.as_quat().T.copy(), CONSENSUS)
    turn = truth.inv() * Rotation.from_quat(found.body_from_world.T)
    assert np.degrees((turn.mean().inv() * turn).magnitude()).max() < 1.0
    assert ((found.good < 0.5) == is_false).mean() > 0.98
    assert np.degrees(found.scale) == pytest.approx(1.0, rel=0.3)


def test_better_starts_are_likelier() -> None:
    edges, truth, _ = _graph(4, 40, 0.4, 1.0)
    elsewhere = Rotation.random(40, random_state=9)
    likely, unlikely = (fitted(edges, each.as_quat().T.copy(), CONSENSUS) for each in (truth, elsewhere))
    assert likely.log_likelihood > unlikely.log_likelihood + 100
