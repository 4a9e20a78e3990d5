"""Jumps: which parts turn by a minimum cut, and where jumps under one cost after the other end."""

from __future__ import annotations

import networkx
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, rotations
from rotavg_ros.solver.algebra.minimum_cut import FlowNetwork
from rotavg_ros.solver.slam import preparation as slam_preparation
from rotavg_ros.solver.slam.noise.model import NoiseModel, agree
from rotavg_ros.solver.slam.posterior.moves.jumps import jump_to_optimum, turns
from rotavg_ros.solver.slam.posterior.moves.truncated_cost import TruncatedCost, no_slip_log_odds
from test.solver.graphs import as_quaternions, measured
from test.solver.slam.posterior.test_slips import laps


def test_a_jump_takes_the_set_that_an_exhaustive_search_finds() -> None:
    """Against all 2⁸ labellings of a small graph, their costs from above as in the cut."""
    rng = np.random.default_rng(0)
    num_nodes = 8
    ends = np.array(list(networkx.gnm_random_graph(num_nodes, 16, seed=3).edges)).T
    kind = np.full(ends.shape[1], EdgeKind.LOOP_CLOSURE)
    chain = np.arange(num_nodes - 1)
    source = np.concatenate((chain, ends[0]))
    target = np.concatenate((chain + 1, ends[1]))
    turned = np.where(rng.random(len(source)) < 0.4, np.radians(40.0), 0.0)
    vector = turned[:, None] * np.array([0, 0, 1.0])
    kind = np.concatenate((np.full(num_nodes - 1, EdgeKind.ODOMETRY), kind))
    truth = Rotation.identity(num_nodes)
    graph = measured(truth, source, target, Rotation.from_rotvec(vector), kind=kind)
    closures = slam_preparation.prepare(graph).closure_graph
    noise = NoiseModel(1, np.radians(1.0) ** 2, np.radians(1.0) ** 2, 0.3)
    cost = TruncatedCost.create(closures, noise, np.zeros(len(closures.source)))
    residual = cost.residual(rotations.identity(closures.num_nodes))
    costs = cost.of_edges(residual)
    turn = rotations.exp(torch.tensor([0.0, 0.0, np.radians(40.0)]).double())
    alone_target = cost.of_edges(rotations.multiply(rotations.inverse(turn).expand(len(residual), 4), residual))
    alone_source = cost.of_edges(rotations.multiply(residual, turn.expand(len(residual), 4)))
    smaller_target = alone_target < alone_source
    source_cost = np.where(smaller_target, np.maximum(alone_source, 2 * costs - alone_target), alone_source)
    target_cost = np.where(smaller_target, alone_target, np.maximum(alone_target, 2 * costs - alone_source))

    def energy(turns: np.ndarray) -> float:
        u, v = turns[closures.source], turns[closures.target]
        return float(np.where(u == v, costs, np.where(u, source_cost, target_cost)).sum())

    bits = (np.arange(2**closures.num_nodes)[:, None] >> np.arange(closures.num_nodes)) & 1 == 1
    least = min(energy(turns) for turns in bits)
    assert least < costs.sum() - 1
    question = turns(cost, residual, turn[None], costs)
    network = FlowNetwork(closures.num_nodes, closures.source, closures.target)
    gained = float(costs.sum()) - least
    for weight in (np.ones(len(costs)), 1e-6 + cost.cap - costs):
        system = cost.pattern.factorize(weight)
        assert energy(question.best_set(network, system)) == pytest.approx(least, abs=0.05)
        (bound,) = question.gain_bounds(system)
        assert gained <= bound + 1e-6


@pytest.mark.parametrize("seed", [0, 1])
def test_a_stretch_that_slips_cut_in_two_is_turned_part_by_part(seed: int) -> None:
    """Two closures want either part turned: less than the slips that a first jump adds, more than all of them."""
    graph, truth, _, _ = laps(
        planar=True, false_share=0.0, seed=seed, num_laps=2, slips={20: 50.0, 22: -35.0, 24: -15.0}
    )
    prepared = slam_preparation.prepare(graph)
    closures, pairs = prepared.closure_graph, prepared.pairs
    noise = NoiseModel(1, np.radians(0.1) ** 2, np.radians(0.5) ** 2, 0.3)
    costs = []
    for probability in (0.5, 0.01):
        none = no_slip_log_odds(closures.own_steps, noise.components, probability)
        prior = np.where(closures.is_odometry, none, noise.prior_log_odds)
        costs.append(TruncatedCost.create(closures, noise, prior))
    start = rotations.identity(closures.num_nodes)
    found = start
    for cost in costs:
        found = jump_to_optimum(cost, found, pairs, agree(pairs, noise))
    at_truth = costs[-1].descend(closures.corrections(as_quaternions(truth)))
    assert costs[-1].total(found) < costs[-1].total(at_truth) + 0.1
    at_once = jump_to_optimum(costs[-1], start, pairs, agree(pairs, noise))
    assert costs[-1].total(at_once) > costs[-1].total(found) + 10
