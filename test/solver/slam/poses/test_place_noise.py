"""How far closures' translations err: absurdly, or in proportion to their length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.slam import stress
from rotavg_ros.solver.slam.poses.em.estimate import judge_of
from rotavg_ros.solver.slam.poses.repeats.neighbours import wrong_share
from rotavg_ros.solver.slam.poses.solve import has_places

from .test_poses import errors, graph_of, pose_mode, simulated
from .test_pulls import alike


def with_closures(graph: ViewGraph, factor: np.ndarray | float) -> ViewGraph:
    """Closures' translations times a factor, one for all or ``(M, 1)``."""
    assert graph.translation is not None
    times = torch.as_tensor(factor, dtype=torch.float64).reshape(-1, 1)
    return replace(
        graph, translation=torch.where(graph.is_odometry[:, None], graph.translation, times * graph.translation)
    )


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("metres", [1e4, 1e12, 1e300])
def test_one_absurd_closure_is_flagged_and_no_other(metres: float) -> None:
    run = simulated(3, false_share=0.2)
    graph = graph_of(run)
    assert graph.translation is not None
    before = solve(graph).outlier_score > 0.5
    good = int(torch.nonzero(~graph.is_odometry & ~before)[0, 0])
    translation = graph.translation.clone()
    translation[good] = torch.tensor([metres, 0.0, 0.0], dtype=torch.float64)
    answer = solve(replace(graph, translation=translation))
    flagged = answer.outlier_score > 0.5
    expected = before.clone()
    expected[good] = True
    assert torch.equal(flagged, expected)
    assert answer.rotation_score is not None and answer.rotation_score[good] < 0.5
    assert errors(run, answer)[1] < 0.3


@pytest.mark.parametrize(
    ("kind", "seed"), [pytest.param("building: 30 % random", 3, marks=pytest.mark.large), ("building: 15 closures", 4)]
)
def test_a_false_closure_moves_nothing_however_far_it_leads(kind: str, seed: int) -> None:
    graph = next(drawings(stress.kinds((kind,), translations=True), [seed])).graph
    assert graph.translation is not None
    without = solve(graph)
    ends = torch.tensor([graph.num_nodes // 5]), torch.tensor([4 * graph.num_nodes // 5])
    rotation = rotations.exp(torch.tensor([[0.0, 0.0, 1.2]], dtype=torch.float64))
    for metres in (50.0, 1e6):
        more = ViewGraph.create(
            torch.cat((graph.source, ends[0])),
            torch.cat((graph.target, ends[1])),
            torch.cat((graph.target_from_source, rotation)),
            num_nodes=graph.num_nodes,
            kind=torch.cat((graph.kind, torch.tensor([1]))),
            precision=torch.cat((graph.precision, torch.tensor([torch.nan], dtype=torch.float64))),
            translation=torch.cat((graph.translation, torch.tensor([[metres, 0.0, 0.0]], dtype=torch.float64))),
        )
        answer = solve(more)
        assert answer.outlier_score[-1] > 0.99
        off = rotations.angle_between(answer.body_from_world, without.body_from_world)
        # Noise may come to rest a solve earlier or later.
        assert (off[1:] / without.uncertainty[1:]).max() < 0.2


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("where", [7, 150])
@pytest.mark.parametrize(
    ("metres", "tells"), [(1e5, True), (1e6, False), (1e15, False), (1e30, False), (1e150, False), (1e300, False)]
)
def test_absurd_odometry_breaks_nothing(metres: float, tells: bool, where: int) -> None:
    """Whatever headings err by: covariances across such a step grow with the square of both."""
    graph = graph_of(simulated(4, num_keyframes=300, odometry_noise_deg=10.0))
    assert graph.translation is not None
    translation = graph.translation.clone()
    translation[int(torch.nonzero(graph.is_odometry)[where, 0]), 0] = metres
    answer = solve(replace(graph, translation=translation))
    assert torch.isfinite(answer.body_from_world).all() and torch.isfinite(answer.outlier_score).all()
    assert (answer.position is not None) == tells


@pytest.mark.parametrize("factor", [1e-20, 1e20])
def test_a_robot_in_other_units_has_places(factor: float) -> None:
    """Where it stands for most of its keyframes, too: steps are not compared with its reports of no motion."""
    graph = graph_of(simulated(4))
    assert graph.translation is not None
    translation = factor * graph.translation
    stands = torch.nonzero(graph.is_odometry)[:300, 0]
    translation[stands] *= 1e-12
    assert has_places(replace(graph, translation=translation))


@pytest.mark.large
def test_closures_that_tell_directions_rather_than_lengths() -> None:
    """Each is short by a factor of its own, as those of two views by one camera are: odometry tells lengths."""
    short, told = [], []
    for seed in range(4):
        run = simulated(seed, closure_radius_m=5.0)
        graph = graph_of(run)
        factor = np.random.default_rng(seed).uniform(0.1, 1.5, (graph.num_edges, 1))
        guessed = with_closures(graph, factor)
        relative = [np.sqrt(pose_mode(each).state.noise.relative) for each in (graph, guessed)]
        assert relative[1] > 2 * relative[0]
        short.append(errors(run, solve(guessed)))
        told.append(errors(run, solve(graph)))
        flagged = (solve(guessed).outlier_score > 0.5).numpy()
        off = np.linalg.norm((1 - factor) * run.edge_translation, axis=1)
        clear = ~run.closure_is_false & ~graph.is_odometry.numpy() & (off < 1.0)
        assert flagged[clear].mean() < 0.02
    assert np.exp(np.log(np.array(short)[:, 0] / np.array(told)[:, 0]).mean()) < 1.3
    assert np.mean(np.array(short)[:, 1]) < 0.5


def test_what_is_told_of_a_closure_does_not_grow_as_it_pulls_less() -> None:
    """Its turn's leverage is none of its shift's: what is predicted of a place stays where others put it."""
    run = simulated(3, false_share=0.2)
    graph = graph_of(run)
    assert graph.translation is not None
    closure = torch.nonzero(~graph.is_odometry)[:, 0]
    translation = graph.translation.clone()
    translation[closure[::4]] = torch.nan
    mode = pose_mode(replace(graph, translation=translation))
    unknown = ~mode.problem.told.is_known
    assert unknown.sum() == len(closure[::4])
    off = np.linalg.norm(mode.solved.predictions.mean[unknown, mode.problem.turns :], axis=1)
    assert off.max() < 10.0  # they lie within two metres of each other
    leverage, redundancy = mode.solved.factor.leverage, mode.solved.factor.redundancy
    np.testing.assert_allclose(
        leverage + redundancy, np.broadcast_to(np.eye(leverage.shape[1]), leverage.shape), atol=1e-6
    )
    assert np.linalg.eigvalsh(redundancy).min() > 0 and np.linalg.eigvalsh(leverage).min() > -1e-9


def test_before_any_solve_as_many_places_may_be_wrong_as_is_believed_beforehand() -> None:
    """What nobody has judged yet is no evidence that all places are right."""
    problem = pose_mode(graph_of(simulated(1))).problem
    count = len(problem.closures)
    judge = judge_of(problem)
    scale = alike(count, variance=1.0, extent=100.0)
    places = judge.nothing_known(np.ones(count, dtype=bool), np.zeros(count), scale)
    wrong = problem.priors.wrong_place / problem.priors.counted
    np.testing.assert_allclose(wrong_share(places.chance, problem.told, problem.priors), wrong)
