"""Components that closures have joined are brought into one gauge before anything is solved."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.online.answer.gauge import joined
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

SIZES = (7, 5, 4)


def chains(random: np.random.Generator, joints: list[tuple[int, int]], false: tuple[int, ...] = ()) -> tuple:
    """Chains of odometry, exact closures between them, and the true orientations."""
    truth = Rotation.random(sum(SIZES), random_state=random)
    starts = np.cumsum((0, *SIZES))
    pairs = [(node, node + 1) for node in range(sum(SIZES) - 1) if node + 1 not in starts]
    kind = [EdgeKind.ODOMETRY] * len(pairs) + [EdgeKind.LOOP_CLOSURE] * len(joints)
    source, target = np.array([*pairs, *joints]).T
    measured = truth[target] * truth[source].inv()
    for joint in false:
        edge = len(pairs) + joint
        measured[edge] = Rotation.random(random_state=random)
    graph = ViewGraph.create(
        num_nodes=sum(SIZES), source=source, target=target, target_from_source=measured.as_quat(), kind=kind
    )
    return graph, torch.from_numpy(truth.as_quat())


def apart(truth: torch.Tensor, random: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Each chain in a gauge of its own; components."""
    component = torch.from_numpy(np.repeat(np.arange(len(SIZES)), SIZES))
    turns = torch.from_numpy(Rotation.random(len(SIZES), random_state=random).as_quat())
    turns[0] = rotations.identity(1)[0]
    return rotations.multiply(truth, turns[component]), component


def off_deg(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float(torch.rad2deg(rotations.angle(rotations.multiply(found, rotations.inverse(truth)))).max())


@given(seed=st.integers(0, 10_000), known=st.integers(1, sum(SIZES)))
def test_exact_closures_give_the_truth_in_the_gauge_of_the_first_node(seed: int, known: int) -> None:
    random = np.random.default_rng(seed)
    joints = [(int(random.integers(7)), int(random.integers(7, 12))), (int(random.integers(12, 16)), 8)]
    graph, truth = chains(random, joints)
    before, component = apart(truth, random)
    assert off_deg(joined(before[:known], component[:known], graph), truth) < 1e-5


@given(seed=st.integers(0, 10_000))
def test_what_most_of_them_say_counts(seed: int) -> None:
    random = np.random.default_rng(seed)
    joints = [(0, 7), (11, 3), (5, 9), (2, 8), (6, 10), (1, 12), (15, 4), (7, 13), (14, 2)]
    graph, truth = chains(random, joints, false=(1, 3, 7))
    before, component = apart(truth, random)
    assert off_deg(joined(before, component, graph), truth) < 1e-5


def test_a_rejected_closure_says_nothing_and_nothing_given_is_changed() -> None:
    random = np.random.default_rng(0)
    graph, truth = chains(random, [(0, 7), (3, 8)], false=(0,))
    graph.label[graph.kind == EdgeKind.LOOP_CLOSURE] = torch.tensor([EdgeLabel.REJECTED, EdgeLabel.AUTOMATIC])
    before, component = apart(truth, random)
    kept = before.clone()
    found = joined(before, component, graph)
    assert torch.equal(before, kept)
    assert off_deg(found[:12], truth[:12]) < 1e-5
    assert off_deg(found[12:], before[12:]) < 1e-9  # still apart


def test_what_somebody_has_accepted_counts_alone() -> None:
    random = np.random.default_rng(3)
    graph, truth = chains(random, [(0, 7), (3, 8), (5, 10), (12, 1)], false=(0,))
    false = graph.target_from_source[-4].clone()
    for edge, (source, target) in zip((-3, -2), ((3, 8), (5, 10)), strict=True):  # all false ones agree
        seen = rotations.multiply(truth[target], rotations.inverse(truth[7]))
        back = rotations.multiply(truth[0], rotations.inverse(truth[source]))
        graph.target_from_source[edge] = rotations.multiply(rotations.multiply(seen, false), back)
    before, component = apart(truth, random)
    assert off_deg(joined(before, component, graph)[:12], truth[:12]) > 5
    graph.label[-2] = EdgeLabel.ACCEPTED
    graph.target_from_source[-2] = rotations.multiply(truth[10], rotations.inverse(truth[5]))
    assert off_deg(joined(before, component, graph)[:12], truth[:12]) < 1e-5


@pytest.mark.parametrize("count", [1, 500])
def test_many_closures_are_no_trouble(count: int) -> None:
    random = np.random.default_rng(1)
    graph, truth = chains(random, [(int(random.integers(7)), int(random.integers(7, 12))) for _ in range(count)])
    noise = torch.from_numpy(Rotation.from_rotvec(random.normal(0, math.radians(2), (graph.num_edges, 3))).as_quat())
    is_closure = (graph.kind == EdgeKind.LOOP_CLOSURE)[:, None]
    graph.target_from_source[:] = torch.where(
        is_closure, rotations.multiply(noise, graph.target_from_source), graph.target_from_source
    )
    before, component = apart(truth, random)
    assert off_deg(joined(before, component, graph)[:12], truth[:12]) < (12 if count == 1 else 4)
