"""How surely cameras with few edges are attached: brute force, formulas, and rates over draws."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver.sfm.certainty.attachment import Attachment, ErrorDensity
from rotavg_ros.solver.sfm.refinement import PRIORS
from rotavg_ros.solver.sfm.starts.parts import Parts
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise

_CAMERAS, _FALSE, _SCALE = 12, 0.3, float(np.radians(8))


def _attached(turn: Rotation) -> tuple[Attachment, ViewGraph]:
    """A camera beside a complete graph, each of its K edges stating a turn, where it is in the answer."""
    source, target = np.triu_indices(_CAMERAS, k=1)
    few = len(turn)
    source, target = np.append(source, np.arange(few)), np.append(target, np.full(few, _CAMERAS))
    truth = random_truth(_CAMERAS + 1, 0)
    relative = truth[target] * truth[source].inv()
    # In the world's frame the camera turns: R W R_s⁻¹.
    stated = truth[[_CAMERAS] * few] * turn * truth[source[-few:]].inv()
    quaternions = np.concatenate((relative.as_quat()[:-few], stated.as_quat()))
    graph = ViewGraph.create(source, target, quaternions, num_nodes=_CAMERAS + 1)
    residual = np.append(np.zeros(len(source) - few), turn.magnitude())
    weight = torch.ones(len(source), dtype=torch.float64)
    parts = Parts.of(graph, torch.from_numpy(residual), weight, PRIORS)
    one = np.zeros(len(source), dtype=np.int64)
    density = ErrorDensity.of(residual, np.zeros(len(source)), one, np.array([_FALSE]), np.array([_SCALE]))
    return Attachment.of(parts, np.ascontiguousarray(truth.as_quat().T), density), graph


def _of_camera(found: Attachment) -> int:
    return int(np.flatnonzero(np.unique(found.parts.node) == _CAMERAS)[0])


def _apart(count: int) -> Rotation:
    """The identity, and turns far from it and from each other."""
    vectors = [[0, 0, 0], [2.2, 0, 0], [0, 2.4, 0], [0, 0, -2.0], [-1.4, 0, 1.0]]
    return Rotation.from_rotvec(np.array(vectors[:count], dtype=float))


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_edges_no_two_of_which_agree_are_all_as_likely(count: int) -> None:
    found, graph = _attached(_apart(count))
    good = (1 - _FALSE) / (count * (1 - _FALSE) + _FALSE)
    assert found.is_right[_of_camera(found)] == pytest.approx(good, abs=0.02)
    score = found.scores(np.append(np.zeros(graph.num_edges - count), [0, *np.ones(count - 1)]))
    if count > 2:  # edges that check each other in pairs have scores of their own
        np.testing.assert_allclose(score[-count:], 1 - good, atol=0.02)
    assert not score[:-count].any()


def test_edges_that_agree_leave_no_doubt() -> None:
    noise = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.5 * _SCALE, (5, 3)))
    found, graph = _attached(noise)
    assert found.is_right[_of_camera(found)] > 0.999
    assert found.scores(np.zeros(graph.num_edges)).max() < 1e-3
    assert found.variances(np.zeros(graph.num_nodes, dtype=np.int64)).max() < 1e-3


@pytest.mark.parametrize(
    "turns",
    [
        pytest.param([[0, 0, 0], [0.1, 0, 0], [2, 0, 0], [2.1, 0, 0.1]], marks=pytest.mark.large),
        [[0, 0, 0], [1.5, 0, 0], [1.5, 0.1, 0]],
        pytest.param([[0, 0, 0], [0, 0.15, 0], [0.1, 0, 0], [0, 0, 2]], marks=pytest.mark.large),
    ],
)
def test_probabilities_are_those_of_brute_force(turns: list[list[float]]) -> None:
    """The posterior at a million random turns."""
    turn = Rotation.from_rotvec(np.array(turns, dtype=float))
    found, _ = _attached(turn)
    tried = Rotation.random(1_000_000, random_state=0)
    density, zero = _density(), np.zeros(len(tried), dtype=np.int64)
    log_posterior, log_none = np.zeros(len(tried)), len(turn) * np.log(_FALSE)
    for one in turn:
        error = (one * tried.inv()).magnitude()
        log_posterior += np.logaddexp(density.log_good(error, zero), density.log_false(error, zero))
    posterior = np.exp(log_posterior)
    # Near the answer, less what there is anywhere because all edges may be false.
    is_near = tried.magnitude() < np.radians(40)
    right = (posterior - np.exp(log_none))[is_near].sum() / posterior.sum()
    assert found.is_right[_of_camera(found)] == pytest.approx(right, abs=0.06)
    square = float((posterior * tried.magnitude() ** 2).sum() / posterior.sum()) / 3
    # The answer's own noise is not the posterior's of its turn.
    assert found.variance[_of_camera(found)] == pytest.approx(square, rel=0.15, abs=0.02)


def _density() -> ErrorDensity:
    none = np.zeros(0)
    return ErrorDensity.of(none, none, none.astype(np.int64), np.array([_FALSE]), np.array([_SCALE]))


def test_a_camera_is_turned_to_where_more_edges_have_it() -> None:
    """Two agree on a turn, one on the answer; with two that agree on the answer as well it stays."""
    turns = np.radians([[0.0, 0, 0], [80, 0, 0], [82, 1, 0]])
    found, graph = _attached(Rotation.from_rotvec(turns))
    at = np.ascontiguousarray(random_truth(graph.num_nodes, 0).as_quat().T)
    turned = found.likelier()
    assert turned is not None
    moved = (Rotation.from_quat(at.T).inv() * Rotation.from_quat(turned.T)).as_rotvec(degrees=True)
    np.testing.assert_allclose(moved[:-1] - moved[0], 0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(moved[-1] - moved[0]), 80, atol=3)
    stays, _ = _attached(Rotation.from_rotvec(np.concatenate((turns, np.radians([[1.0, 0, 2]])))))
    assert stays.likelier() is None
    open_, _ = _attached(_apart(4))
    assert open_.likelier() is None


def test_the_answer_follows_the_edges_that_agree_not_the_lowest_cost() -> None:
    """Of nine edges of a camera three are good; the cost of a turn by 60°, where two agree, is less."""
    source, target = np.triu_indices(30, k=1)
    few = np.arange(9)
    source, target = np.append(source, few), np.append(target, np.full(9, 30))
    truth, noise = random_truth(31, 9), small_noise(len(source), 1.0, 3).as_rotvec()
    good, agreeing = [[0, 1, 0], [1, 0, 0], [0, 0, 1]], [[60, 0, 0], [61, 0, 0]]
    noise[-9:] = np.radians([*good, *agreeing, [100, 0, 0], [90, 40, 0], [90, -40, 0], [85, 0, 35]])
    stated = Rotation.from_rotvec(noise[-9:])
    cost = [float(np.sqrt((stated * turn.inv()).magnitude()).sum()) for turn in (stated[0], stated[3])]
    assert cost[0] > 1.1 * cost[1]
    graph = measured(truth, source, target, Rotation.from_rotvec(noise))
    solution = solve(graph, profile="sfm")
    error = orientation_errors(solution.body_from_world, as_quaternions(truth))
    assert float(torch.rad2deg(error[-1])) < 5


def test_false_edges_that_err_by_one_angle_do_not_turn_a_camera() -> None:
    """Four edges say 90°, three what the answer says; but all other false edges err by 90°, and none by 0."""
    turn = Rotation.from_rotvec(np.radians([[0, 0, 0], [1, 0, 0], [0, 1, 0], [90, 0, 0], [90, 1, 0], [0, -90, 0]]))
    found, graph = _attached(turn)
    angle, score = np.append(np.full(200, np.radians(90)), np.zeros(400)), np.append(np.ones(200), np.zeros(400))
    at = np.ascontiguousarray(random_truth(graph.num_nodes, 0).as_quat().T)
    component = np.zeros(600, dtype=np.int64)
    learned = ErrorDensity.of(angle, score, component, np.array([_FALSE]), np.array([_SCALE]))
    likelier = Attachment.of(found.parts, at, learned).is_right[_of_camera(found)]
    assert found.is_right[_of_camera(found)] < likelier
    assert likelier > 0.99


def test_scores_and_deviations_of_cameras_with_few_edges_are_right_on_average() -> None:
    """Forty cameras that see each other, and 150 that see three of them each, with four false edges of ten."""
    rng = np.random.default_rng(3)
    source, target = np.triu_indices(40, k=1)
    few = 150
    source = np.append(source, np.concatenate([rng.choice(40, 3, replace=False) for _ in range(few)]))
    target = np.append(target, 40 + np.repeat(np.arange(few), 3))
    truth = random_truth(40 + few, 4)
    false = rng.random(len(source)) < 0.4
    random = Rotation.random(len(source), random_state=5).as_quat()
    noise = Rotation.from_quat(np.where(false[:, None], random, small_noise(len(source), 2.0, 6).as_quat()))
    graph = measured(truth, source, target, noise)
    solution = solve(graph, profile="sfm")
    wrong, score = noise.magnitude()[-3 * few :] > np.radians(20), solution.outlier_score.numpy()[-3 * few :]
    for low, high in ((0, 0.1), (0.1, 0.6), (0.6, 0.9), (0.9, 1)):
        chosen = (score >= low) & (score <= high)
        assert abs(float(score[chosen].sum() - wrong[chosen].sum())) < 3 * np.sqrt(0.25 + chosen.sum() / 4)
    root = as_quaternions(truth * truth[0].inv())
    error = rotations.log(rotations.multiply(rotations.inverse(root), solution.body_from_world))[40:]
    squared = (error**2).mean(dim=1) / solution.uncertainty[40:] ** 2
    assert 0.5 < float(squared.mean().sqrt()) < 1.5
