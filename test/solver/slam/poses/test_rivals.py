"""Labellings of rotations that are compared by their poses."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.evaluation.slam import stress
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.running.work import metered
from rotavg_ros.solver.slam import stages
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.publishing import answer as published
from rotavg_ros.solver.slam.poses.publishing.answer import Poses, answer
from rotavg_ros.solver.slam.poses.search.rivals import rival_poses
from rotavg_ros.solver.slam.poses.search.settling import settling
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.solve import Found, search
from rotavg_ros.view_graph import ViewGraph

from .test_poses import graph_of, pose_mode, simulated


def found_of(kind: str, seed: int, without: Collection[str] = ()) -> tuple[ViewGraph, np.ndarray, Found]:
    (case,) = (one.draw(seed) for one in stress.kinds([kind], translations=True) if one.name == kind)
    assert case is not None and case.graph.translation is not None
    graph = case.graph
    return graph, graph.translation.numpy(), search(graph, load_network(SlamCleanNet), stages.bootstrap, without)


@torch.no_grad()
@pytest.mark.parametrize(
    ("kind", "gain"),
    [("hills: 30 % near misses", 50.0), pytest.param("3 robots: half random", -1.0, marks=pytest.mark.large)],
)
def test_a_labelling_follows_its_places_to_one_that_is_likelier(kind: str, gain: float) -> None:
    """Near misses of rotation whose places are far off; and where rotations are right already, nothing is lost."""
    graph, translation, found = found_of(kind, 6)
    mode = found.modes[0]
    as_it_was = mode.cost + estimate_poses(PoseProblem(graph, translation, mode), hold=True).cost
    rival = settling(estimate_poses(PoseProblem(graph, translation, mode)))
    assert rival.cost < as_it_was - gain
    changed = int((rival.mode.is_false != mode.is_false).sum())
    assert changed > 10 if gain > 0 else changed < 10


@pytest.mark.large
@torch.no_grad()
def test_tearing_robots_apart_makes_nothing_likelier() -> None:
    """All closures false: where three robots are then is known by nobody, and no room to be anywhere is gained."""
    graph, translation, found = found_of("3 robots: half random", 6)
    mode = found.modes[0]
    all_false = mode.state.trusted.copy()
    all_false[mode.problem.closure] = 0.0
    torn = Mode(mode.problem, *polish(mode.problem, replace(mode.state, trusted=all_false)), "torn")
    costs = [each.cost + estimate_poses(PoseProblem(graph, translation, each), hold=True).cost for each in (mode, torn)]
    assert costs[1] > costs[0] + 100
    rivals = rival_poses(graph, translation, found.modes)
    assert rivals.share[0] > 0.9 and not rivals.modes[0].is_false.all()


@pytest.mark.large
@torch.no_grad()
def test_places_are_asked_of_the_labelling_without_slips_too() -> None:
    """Rotations alone prefer a slip, by far more than what rivals are compared for; places know that nothing jumped."""
    graph, translation, found = found_of("building: 30 % random", 6)
    sound = next(mode for mode in found.modes if len(mode.slipped) == 0)
    problem = sound.problem
    trusted, correction = sound.state.trusted.copy(), sound.state.correction.copy()
    edge = int(problem.graph.num_segments // 2)
    trusted[edge] = 0.0
    later = problem.graph.position
    after = later >= later[problem.graph.target[edge]]
    quarter = np.array([[0.0], [0.0], [np.sqrt(0.5)], [np.sqrt(0.5)]])
    correction[:, after] = quaternion_rows.multiply(correction[:, after], quarter)
    across = after[problem.graph.source[problem.closure]] != after[problem.graph.target[problem.closure]]
    trusted[problem.closure[across]] = 0.0
    state = replace(sound.state, trusted=trusted, correction=correction)
    slipped = Mode(problem, *polish(problem, state), "slip")
    assert len(slipped.slipped) == 1
    # As rotations would have it in a building that looks alike turned.
    gap = 100.0 + slipped.cost - sound.cost
    unlikely = replace(sound, evaluation=replace(sound.evaluation, terms=sound.evaluation.terms | {"gap": gap}))
    rivals = rival_poses(graph, translation, [slipped, unlikely])
    assert [len(mode.slipped) for mode in rivals.modes] == [0]


@pytest.mark.large
@torch.no_grad()
def test_begun_beside_a_labelling_of_the_same_closures_ends_as_from_nothing() -> None:
    """Slips elsewhere, or a single closure that is held otherwise: the same poses, up to where iterations rest."""
    graph, translation, found = found_of("city: small slips, 30 % random, noisy closures", 3, ["wide-tails"])
    first = found.modes[0]
    others = [mode for mode in found.modes[1:6] if first.holds_like(mode.state)]
    assert any(not np.array_equal(mode.slipped, first.slipped) for mode in others)
    begun = estimate_poses(PoseProblem(graph, translation, first))
    for mode in others:
        problem = PoseProblem(graph, translation, mode)
        with metered() as spent_beside:
            beside = estimate_poses(problem, start=PoseStart.beside(begun, problem))
        with metered() as spent_anew:
            anew = estimate_poses(problem)
        assert spent_beside.spent < 0.7 * spent_anew.spent
        assert beside.solved.places.is_like(anew.solved.places)
        turned = np.abs((beside.state.correction * anew.state.correction).sum(axis=0)).min()
        assert 2 * np.arccos(min(turned, 1.0)) < np.radians(0.5)


@torch.no_grad()
def test_labellings_hold_the_same_closures_up_to_single_ones() -> None:
    mode = found_of("building: 30 % random", 6)[2].modes[0]
    closure, run = mode.problem.closure, mode.problem.run
    longest = np.flatnonzero(run == np.argmax(np.bincount(run)))
    for changed, is_alike in ((longest[:0], True), (longest[:1], True), (longest[:2], False)):
        trusted = mode.state.trusted.copy()
        trusted[closure[changed]] = 1 - trusted[closure[changed]]
        assert mode.holds_like(replace(mode.state, trusted=trusted)) == is_alike


def test_the_median_goes_by_places_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three labellings agree on where half of the map lies; the third lies between them in orientation."""
    mode = pose_mode(graph_of(simulated(0, num_keyframes=100)))
    single = published._of_mode(mode)
    behind = np.arange(len(single.position)) >= 50

    def doctored(turn: float, shift: float) -> Poses:
        turned = Rotation.from_rotvec(turn * behind[:, None] * [0.0, 0.0, 1.0])
        orientation = (Rotation.from_quat(single.body_from_world) * turned).as_quat()
        position = single.position + shift * behind[:, None] * [1.0, 0.0, 0.0]
        return replace(single, body_from_world=orientation, position=position)

    rivals = [replace(mode) for _ in range(3)]
    made = {id(each): doctored(turn, x) for each, turn, x in zip(rivals, (0.0, 1e-4, 2e-4), (0, 20, 0), strict=True)}
    monkeypatch.setattr(published, "_of_mode", lambda pose: made[id(pose)])
    share = np.array([0.45, 0.30, 0.25])
    found, middle = answer(rivals, share)
    assert middle == 0
    # The third answer is told of: in the uncertainty, and in a warning.
    assert found.position_variance[behind].min() > 0.3 * 20.0**2 / mode.problem.shifts
    assert len(found.warnings) == 1 and "20.0 m" in found.warnings[0]
    # In metres as in turns: where places agree, orientations decide.
    made.update({id(each): doctored(turn, 0.0) for each, turn in zip(rivals, (0.0, 0.1, 0.2), strict=True)})
    assert answer(rivals, share)[1] == 1
