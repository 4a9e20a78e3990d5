"""What is known where a slip may as well have been elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, rotations
from rotavg_ros.solver.slam import preparation as slam_preparation
from rotavg_ros.solver.slam.moves.moved_slips import with_moved_slips
from rotavg_ros.solver.slam.moves.slip_search import no_slip_log_odds
from rotavg_ros.solver.slam.moves.truncated_cost import TruncatedCost
from rotavg_ros.solver.slam.noise.model import NoiseModel
from test.solver.graphs import measured, random_truth

NUM_NODES, SLIP = 41, np.radians(50.0)
NOISE = NoiseModel(1, np.radians(0.1) ** 2, np.radians(0.5) ** 2, 0.3)


def there_and_back(told_apart: bool) -> tuple[slam_preparation.Prepared, torch.Tensor, np.ndarray]:
    """Closures between the way out and the way back; a slip after keyframe 10, as found. Corrections, probabilities.

    The same closures span the step after keyframe 29. On request others, to where the robot turned, tell them apart.
    """
    low = np.arange(21)
    high = np.append(40 - low[:20], 22)
    if told_apart:
        low, high = np.concatenate((low, np.arange(5, 15))), np.concatenate((high, np.full(10, 20)))
    source = np.concatenate((np.arange(NUM_NODES - 1), low))
    target = np.concatenate((np.arange(1, NUM_NODES), high))
    vector = np.zeros((len(source), 3))
    vector[10, 2] = SLIP
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [NUM_NODES - 1, len(low)])
    truth = random_truth(NUM_NODES, 0, planar=True)
    prepared = slam_preparation.prepare(measured(truth, source, target, Rotation.from_rotvec(vector), kind=kind))
    graph = prepared.closure_graph
    correction = graph.corrections(torch.from_numpy((truth * truth[0].inv()).as_quat()))
    first = rotations.inverse(correction[:1]).expand(len(correction), 4)
    correction = rotations.normalize(rotations.multiply(correction, first))
    good = np.ones(len(graph.source))
    good[10] = 0.01
    return prepared, correction, good


@pytest.mark.parametrize("told_apart", [False, True])
def test_what_lies_between_two_places_is_known_up_to_the_turn(told_apart: bool) -> None:
    """Against the costs of all places, each solution made and counted by itself."""
    prepared, correction, good = there_and_back(told_apart)
    graph = prepared.closure_graph
    odds = np.zeros(len(graph.source))
    prior = np.where(graph.is_odometry, no_slip_log_odds(graph.steps, 1), NOISE.prior_log_odds)
    cost = TruncatedCost.create(graph, NOISE, prior)
    turn = cost.residual(correction)[10]
    assert float(rotations.log(turn).norm()) == pytest.approx(SLIP)

    weight = {10: 1.0}
    for place in range(NUM_NODES - 1):
        low, high = min(place, 10) + 1, max(place, 10) + 1
        moved = correction.clone()
        by = turn if place > 10 else rotations.inverse(turn)
        moved[low:high] = rotations.multiply(correction[low:high], by.expand(high - low, 4))
        if place != 10:
            weight[place] = float(np.exp(-max(cost.total(moved) - cost.total(correction), 0.0)))
    share = np.array([weight[place] for place in range(NUM_NODES - 1)]) / sum(weight.values())
    turned = [share[k:].sum() if k > 10 else share[:k].sum() for k in range(NUM_NODES)]

    samples = np.full((NUM_NODES, 4), 0.01)
    second_moment = (with_moved_slips(samples, graph, correction, good, NOISE, odds) ** 2).mean(axis=1)
    np.testing.assert_allclose(second_moment - 1e-4, SLIP**2 * np.array(turned), atol=1e-6)
    stated = np.degrees(np.sqrt(second_moment))
    if told_apart:
        assert stated.max() < 3
    else:
        assert stated[14:27].min() > 30
        assert stated[[*range(8), *range(33, 41)]].max() < 3


def test_without_slips_nothing_is_added() -> None:
    prepared, correction, good = there_and_back(False)
    samples = np.ones((NUM_NODES, 4))
    graph = prepared.closure_graph
    odds = np.zeros(len(good))
    assert with_moved_slips(samples, graph, correction, np.ones_like(good), NOISE, odds) is samples
