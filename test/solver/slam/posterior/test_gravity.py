"""Orientations by rotations alone, where odometry errs about the vertical and hardly about other axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.slam.posterior.publishing.gravity import held_by_gravity
from rotavg_ros.solver.slam.posterior.rows import residuals

from ..poses.test_poses import HILLS, graph_of, pose_mode, simulated
from ..poses.test_poses import held_by_gravity as made_held


@torch.no_grad()
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 2))])
def test_it_is_stationary_under_both_variances(seed: int) -> None:
    """Forces of all rows on every node cancel, those of turns about the vertical and those of others."""
    mode = pose_mode(made_held(simulated(seed, **HILLS), 0.3, seed)).problem.mode
    problem, solved = mode.problem, mode.evaluation.factorised
    held = held_by_gravity(problem, mode.state, solved)
    assert held.factor[1] < 0.1 * held.factor[0]
    vertical = problem.upright
    assert vertical is not None
    segments = slice(problem.graph.num_segments)
    sound = np.flatnonzero(mode.state.is_good[segments])
    axis = vertical.sharpened(residuals(problem, mode.state)[sound], 1 / solved.weight[sound])
    about, residual, free = (
        np.outer(axis, axis),
        residuals(problem, held.state),
        np.ones(solved.system.size, dtype=bool),
    )
    free[problem.graph.roots] = False
    for axes, factor in zip((about, np.eye(3) - about), held.factor, strict=True):
        weight = solved.weight.copy()
        weight[sound] /= factor
        force = np.abs(solved.system.rows.T @ (weight[:, None] * (residual @ axes)))
        rows = abs(solved.system.rows).T @ (weight[:, None] * np.abs(residual @ axes))
        assert (force[free] < 0.02 * rows[free].max()).all()


@torch.no_grad()
def test_without_a_vertical_nothing_changes() -> None:
    mode = pose_mode(graph_of(simulated(0))).problem.mode
    held = held_by_gravity(mode.problem, mode.state, mode.evaluation.factorised)
    assert held.state is mode.state
    assert (held.factor == 1).all()


@torch.no_grad()
def test_where_all_axes_err_alike_both_variances_come_out_so() -> None:
    mode = pose_mode(graph_of(simulated(1, **HILLS))).problem.mode
    held = held_by_gravity(mode.problem, mode.state, mode.evaluation.factorised)
    assert 0.5 < held.factor[1] / held.factor[0] < 2.0
    assert not np.array_equal(held.state.correction, mode.state.correction)


@torch.no_grad()
@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.large) for seed in (4, 5))])
def test_what_errs_about_one_axis_has_no_tails_for_that(seed: int) -> None:
    """Squares of one normal component are spread like those of three that have tails."""
    run = simulated(seed, **HILLS, closures_per_keyframe=0.3, false_share=0.2)
    held, free = (pose_mode(graph).problem.mode.state.noise for graph in (made_held(run, 0.3, seed), graph_of(run)))
    assert held.step_tails == 0
    assert held.step_told < 0.75 < 0.9 < free.step_told


@pytest.mark.parametrize("change", ["axes of the body", "order and direction"])
def test_what_gravity_holds_is_held_in_whatever_axes_and_order(change: str) -> None:
    run = simulated(4, **HILLS, closures_per_keyframe=0.3, false_share=0.2)
    graph = replace(made_held(run, 0.3, 4), translation=None)
    solution, turn = solve(graph), rotations.identity(1)
    if change == "axes of the body":
        turn = torch.from_numpy(Rotation.random(1, random_state=3).as_quat())
        turned = rotations.multiply(rotations.multiply(turn, graph.target_from_source), rotations.inverse(turn))
        other = solve(replace(graph, target_from_source=rotations.normalize(turned)))
        scores = other.outlier_score
    else:
        backwards = torch.arange(graph.num_edges).flip(0)
        reverse = graph.select_edges(backwards)
        other = solve(
            replace(
                reverse,
                source=reverse.target,
                target=reverse.source,
                target_from_source=rotations.inverse(reverse.target_from_source),
            )
        )
        scores = other.outlier_score[backwards]
    found = rotations.multiply(rotations.inverse(turn), other.body_from_world)
    assert float(orientation_errors(found, solution.body_from_world).max()) < 1e-6
    torch.testing.assert_close(scores, solution.outlier_score, rtol=0, atol=1e-5)
