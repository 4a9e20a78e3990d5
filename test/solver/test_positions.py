from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.linalg import lsqr
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph
from rotavg_ros.online.answer.trajectory import dead_reckoning
from rotavg_ros.solver.positions import Translations, fit_positions


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    """Four laps of city streets; three closures in ten are false."""
    return simulate_slam_graph(RobotRun("city", false_share=0.3).config(), np.random.default_rng(4))


def fit(run: SimulatedRun, translation: np.ndarray, score: np.ndarray) -> np.ndarray:
    graph = run.graph
    is_odometry = graph.is_odometry.numpy()
    origin = np.tile(run.position[0], (graph.num_nodes, 1))
    ends = graph.source.numpy(), graph.target.numpy()
    edges = Translations(*ends, translation, is_odometry, score, graph.steps.numpy())
    return fit_positions(run.world_from_body, edges, origin)


def true_translation(run: SimulatedRun) -> np.ndarray:
    source, target = run.graph.source.numpy(), run.graph.target.numpy()
    return Rotation.from_quat(run.world_from_body[source]).inv().apply(run.position[target] - run.position[source])


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def test_true_translations_give_true_positions(run: SimulatedRun) -> None:
    exact = true_translation(run)
    np.testing.assert_allclose(fit(run, exact, np.zeros(len(exact))), run.position, atol=1e-4)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_without_closures_it_is_dead_reckoning(run: SimulatedRun, seed: int) -> None:
    """Another piece of code, and steps that are noise; closures are all outliers or have no translation."""
    rng = np.random.default_rng(seed)
    translation = np.where(run.graph.is_odometry.numpy()[:, None], rng.normal(size=run.edge_translation.shape), np.nan)
    score = np.zeros(len(translation))
    if rng.random() < 0.5:
        score[~run.graph.is_odometry.numpy()] = rng.uniform(0.51, 1)
        translation = np.nan_to_num(translation, nan=7.0)
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (len(run.position), 1))
    steps = translation[run.graph.is_odometry.numpy()]
    walked = run.position[0] + np.vstack((np.zeros(3), np.cumsum(steps, axis=0)))
    # An odometry that never turns has these steps as its positions' differences in the body's own frame.
    expected = dead_reckoning(run.world_from_body, identity, walked)
    np.testing.assert_allclose(fit(run, translation, score), expected, atol=1e-6)


def test_closures_mend_what_steps_have_lost(run: SimulatedRun) -> None:
    """Even where every false closure passed for a good one."""
    positions = fit(run, run.edge_translation, np.zeros(len(run.edge_translation)))
    without = fit(run, run.edge_translation, np.where(run.graph.is_odometry.numpy(), 0.0, 1.0))
    assert rms(positions - run.position) < 0.25 * rms(without - run.position)

    ends = run.graph.source.numpy(), run.graph.target.numpy()
    rows = np.arange(len(ends[0]))  # everybody's least squares, every edge alike
    signs = np.repeat([-1.0, 1.0], len(rows))
    plain = coo_array((signs, (np.tile(rows, 2), np.concatenate(ends))), shape=(len(rows), len(run.position)))
    steps = Rotation.from_quat(run.world_from_body[ends[0]]).apply(run.edge_translation)
    misled = np.stack([lsqr(plain.tocsr(), axis, atol=1e-10, btol=1e-10)[0] for axis in steps.T], axis=1)
    misled += (run.position - misled).mean(axis=0)
    assert rms(positions - run.position) < 0.1 * rms(misled - run.position)


def test_parts_that_nothing_joins_begin_where_they_are_told() -> None:
    """Two pairs and a lone node; the second pair's edge runs backward."""
    quarter = Rotation.from_euler("z", 90, degrees=True).as_quat()
    identity = np.array([0.0, 0.0, 0.0, 1.0])
    origin = np.array([[0.0, 0, 0], [9, 9, 9], [5, 0, 0], [9, 9, 9], [7, 7, 7]])
    positions = fit_positions(
        np.stack([quarter, identity, identity, quarter, identity]),
        Translations(
            np.array([0, 3]),
            np.array([1, 2]),
            np.array([[1.0, 0, 0], [2.0, 0, 0]]),
            np.array([True, False]),
            np.zeros(2),
            np.ones(2),
        ),
        origin,
    )
    np.testing.assert_allclose(positions[:4], [[0, 0, 0], [0, 1, 0], [5, 0, 0], [5, -2, 0]], atol=1e-5)
    assert np.isnan(positions[4]).all()


@pytest.mark.parametrize(("step", "num_nodes"), [(1.0, 4), (0.3, 8), (10.1, 6)])
def test_closures_that_fit_exactly(step: float, num_nodes: int) -> None:
    """Along a line, where the residuals of some are 0 and of others rounding."""
    position = step * np.arange(num_nodes)[:, None] * [1, 0, 0]
    chain = np.arange(num_nodes - 1)
    source, target = np.triu_indices(num_nodes, 2)
    source, target = np.append(chain, source), np.append(chain + 1, target)
    is_odometry = np.arange(len(source)) < len(chain)
    score, steps = np.zeros(len(source)), np.ones(len(source))
    edges = Translations(source, target, position[target] - position[source], is_odometry, score, steps)
    fitted = fit_positions(np.tile([0.0, 0, 0, 1], (num_nodes, 1)), edges, np.zeros((num_nodes, 3)))
    np.testing.assert_allclose(fitted, position, atol=1e-12 * step * num_nodes)
