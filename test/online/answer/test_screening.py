"""How far an answer explains a closure, against scipy's densities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from rotavg_ros.online.answer.screening import Known, score_of
from rotavg_ros.view_graph import ViewGraph

IN_SPACE = ViewGraph.create([0, 0], [1, 1], Rotation.from_rotvec([[0.1, 0, 0], [0, 0.1, 0]]).as_quat())

NODES = 6


def known(seed: int, deviation: float = 0.05) -> Known:
    """Orientations anywhere, each with a variance of its own; two components."""
    rng = np.random.default_rng(seed)
    return Known(
        torch.from_numpy(Rotation.random(NODES, random_state=seed).as_quat(canonical=True)),
        torch.from_numpy(rng.uniform(0, 0.01, NODES)),
        torch.tensor([0, 0, 0, 0, 0, 1]),
        deviation=deviation,
    )


def closure(answer: Known, source: int, target: int, error: Rotation) -> ViewGraph:
    """What the answer says of two nodes, off by so much."""
    body_from_world = Rotation.from_quat(answer.body_from_world.numpy())
    measured = body_from_world[target] * error * body_from_world[source].inv()
    return ViewGraph.create([source], [target], [measured.as_quat()], num_nodes=NODES)


@given(seed=st.integers(0, 20), angle=st.floats(0.001, 3.1), deviation=st.floats(0.02, 0.5))
@settings(max_examples=60, deadline=None)
def test_log_odds_are_those_of_scipys_densities(seed: int, angle: float, deviation: float) -> None:
    answer = known(seed, deviation)
    axis = Rotation.random(random_state=seed).apply([1, 0, 0])
    variance = deviation**2 + float(answer.variance[1] + answer.variance[4])
    good = multivariate_normal(cov=variance * np.eye(3)).logpdf(angle * axis)
    # Of rotations that are all as likely, the angle has the density (1 - cos r) / π; on a sphere of 4 π r².
    anywhere = np.log((1 - np.cos(angle)) / np.pi / (4 * np.pi * angle**2))
    found = answer.log_odds(closure(answer, 1, 4, Rotation.from_rotvec(angle * axis)), IN_SPACE)
    np.testing.assert_allclose(found, good - anywhere, rtol=1e-6, atol=1e-6)


@given(angle=st.floats(0.001, 3.1), deviation=st.floats(0.02, 0.5))
@settings(max_examples=20, deadline=None)
def test_where_all_turn_about_one_axis_any_rotation_is_one_about_that(angle: float, deviation: float) -> None:
    answer = replace(known(0, deviation), body_from_world=torch.tensor([[0.0, 0, 0, 1]] * NODES, dtype=torch.float64))
    turned = closure(answer, 1, 4, Rotation.from_rotvec([0, 0, angle]))
    variance = deviation**2 + float(answer.variance[1] + answer.variance[4])
    expected = multivariate_normal(cov=variance).logpdf(angle) + np.log(2 * np.pi)
    np.testing.assert_allclose(answer.log_odds(turned, turned), expected, rtol=1e-6, atol=1e-6)


def test_a_score_is_the_probability_that_the_log_odds_say() -> None:
    np.testing.assert_allclose(score_of(np.array([0.0, np.log(3), -np.log(3)])), [0.5, 0.25, 0.75])
    assert score_of(np.array([-1e9, 1e9])).tolist() == pytest.approx([1.0, 0.0], abs=1e-15)


def test_between_components_nothing_is_known() -> None:
    answer = known(1)
    between = closure(answer, 0, 5, Rotation.from_rotvec([1.0, 0, 0]))
    assert answer.log_odds(between, IN_SPACE).tolist() == [0.0]


def test_a_wrong_place_is_told_by_the_translation() -> None:
    """Right rotation, but the target is 20 m from where the positions say."""
    answer = known(2)
    at = np.random.default_rng(0).uniform(-50, 50, (NODES, 3))
    answer = replace(answer, position=torch.from_numpy(at), position_variance=torch.zeros(NODES, dtype=torch.float64))
    exact = closure(answer, 0, 3, Rotation.identity())
    seen = Rotation.from_quat(answer.body_from_world[0].numpy()).apply(at[3] - at[0])
    right, wrong = (
        answer.log_odds(replace(exact, translation=torch.from_numpy(seen + off)[None]), IN_SPACE)[0]
        for off in ([0, 0, 0], [20, 0, 0])
    )
    rotation_alone = answer.log_odds(exact, IN_SPACE)[0]
    assert wrong < 0 < rotation_alone < right


def test_new_keyframes_follow_odometry_and_are_less_sure_step_by_step() -> None:
    answer = replace(known(3), step_variance=0.01)
    step = Rotation.from_rotvec([0, 0, 0.3])
    turn = [step.as_quat()] * 2
    grown = ViewGraph.create([4, NODES], [NODES, NODES + 1], turn, kind=[0, 0])
    now = answer.carried_on(grown)
    expected = step * Rotation.from_quat(answer.body_from_world[4].numpy())
    assert (Rotation.from_quat(now.body_from_world[NODES].numpy()) * expected.inv()).magnitude() < 1e-9
    extra = now.variance[NODES:] - now.variance[NODES - 1]
    np.testing.assert_allclose(extra.numpy(), [0.01, 0.02])
    assert torch.equal(now.of_keyframes(lambda rows: rows[:NODES]).variance, answer.variance)
