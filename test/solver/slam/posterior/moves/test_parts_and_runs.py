"""Moves for what no single flip, slip or shift leads out of: two slips taken for one, and runs that hold each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.left_out import relabelled
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.runs import propose_rejected_runs
from rotavg_ros.solver.slam.posterior.moves.splits import propose_splits
from rotavg_ros.solver.slam.posterior.moves.starts import at, initial_noise
from rotavg_ros.solver.slam.posterior.publishing.modes import warnings_of
from rotavg_ros.solver.slam.posterior.solve import Drawn
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise

LAP, LAPS = 40, 4
FIRST, SECOND = 60, 70


def laps(
    slips: dict[int, float], is_false: np.ndarray | None = None, off_deg: float = 0.0
) -> tuple[ViewGraph, Rotation]:
    """Laps in the plane, every other place seen again on all later ones; some closures off by one turn of the world."""
    truth = random_truth(LAP * LAPS, 0, planar=True)
    first, second = np.triu_indices(LAPS, 1)
    place = np.arange(0, LAP, 2)[:, None]
    closures = np.stack(((place + LAP * first).ravel(), (place + LAP * second).ravel()), axis=1)
    source = np.concatenate((np.arange(LAP * LAPS - 1), closures[:, 0]))
    target = np.concatenate((np.arange(1, LAP * LAPS), closures[:, 1]))
    vector = small_noise(
        len(source), np.repeat([0.1, 0.5], [LAP * LAPS - 1, len(closures)]), 0, planar=True
    ).as_rotvec()
    for step, angle in slips.items():
        vector[step, 2] += np.radians(angle)
    if is_false is not None:
        vector[LAP * LAPS - 1 :][is_false, 2] += np.radians(off_deg)
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [LAP * LAPS - 1, len(closures)])
    return measured(truth, source, target, Rotation.from_rotvec(vector), kind=kind), truth


def mode_at(drawn: Drawn, body_from_world: Rotation, slipped: list[int]) -> Mode:
    """The labelling that orientations speak for, odometry slipping after some nodes alone."""
    graph, problem = drawn.problem.graph, drawn.problem
    correction = drawn.prepared.closure_graph.corrections(as_quaternions(body_from_world))
    state = at(problem, correction, np.ones(len(graph.source)), initial_noise(drawn.prepared.noise))
    trusted = relabelled(problem, state)
    start = np.minimum(graph.nodes[graph.source], graph.nodes[graph.target])[: graph.num_segments]
    trusted[: graph.num_segments] = 1.0
    for after in slipped:
        # The segment that the step lies in is the last that starts before it.
        trusted[int(np.argmax(np.where(start <= after, start, -1)))] = 0.0
    return Search(problem).polished(replace(state, trusted=trusted), "begun")


@pytest.mark.parametrize(("taken", "other"), [(FIRST, SECOND), (SECOND, FIRST)])
def test_one_slip_that_was_two_is_split(taken: int, other: int) -> None:
    """What lies between is turned by the one; the closures from there are held false, and agree."""
    graph, truth = laps({FIRST: 45.0, SECOND: 77.0})
    drawn = Drawn.of(graph, None)
    right = mode_at(drawn, truth, [FIRST, SECOND])
    between = slice(FIRST + 1, SECOND + 1)
    turned = truth.as_quat()
    angle = 77.0 if other == SECOND else 45.0
    candidates = []
    for sign in (1, -1):
        moved = turned.copy()
        moved[between] = (truth[between] * Rotation.from_rotvec([0, 0, np.radians(sign * angle)])).as_quat()
        candidates.append(mode_at(drawn, Rotation.from_quat(moved), [taken]))
    merged = min(candidates, key=lambda mode: mode.cost)
    assert merged.cost > right.cost + 20
    best = min(propose_splits(merged), key=lambda proposal: proposal.predicted)
    assert best.predicted < -5
    found = Search(drawn.problem).polished(best.make(), best.name)
    assert found.cost < right.cost + 3
    assert len(found.slipped) == 2


@pytest.mark.parametrize(("off_deg", "closure_tails"), [(4.0, 0.0), (14.0, 0.02), (14.0, 0.1)])
def test_a_run_that_holds_itself_good_is_rejected_as_one(off_deg: float, closure_tails: float) -> None:
    """Each is what the others predict, or in the tails; no single flip lowers F."""
    count = LAP // 2 * len(np.triu_indices(LAPS, 1)[0])
    closures = np.arange(count)
    # The last lap's closures with the first one, at eight places.
    is_run = np.isin(closures // 6, np.arange(6, 14)) & (closures % 6 == 2)
    graph, truth = laps({}, is_run, off_deg)
    drawn = Drawn.of(graph, None)
    begun = mode_at(drawn, truth, [])
    problem = drawn.problem
    trusted = begun.state.trusted.copy()
    trusted[problem.closure] = 1.0
    noise = replace(begun.state.noise, closure_tails=closure_tails)
    held = Search(problem).polished(replace(begun.state, trusted=trusted, noise=noise), "held")
    best = min(propose_rejected_runs(held), key=lambda proposal: proposal.predicted)
    found = Search(problem).polished(best.make(), best.name)
    assert best.predicted < -5
    assert found.cost - held.cost < best.predicted + 5


def test_a_run_that_alone_holds_a_loop_is_rejected_in_a_rival() -> None:
    """A run off by 25° where odometry knows no better: all else bends until it fits, and it leaves no residual."""
    length, places = 600, np.arange(0, 580, 6)
    truth = random_truth(length, 0, planar=True)
    run = np.stack((60 + np.arange(6), 520 + np.arange(6)))
    # Many runs of good closures, over short stretches: what they leave is more than what the false run leaves.
    near = np.concatenate([np.stack((places[k : k + 4], places[k : k + 4] + 15)) for k in range(0, 92, 6)], axis=1)
    source = np.concatenate((np.arange(length - 1), near[0], run[0]))
    target = np.concatenate((np.arange(1, length), near[1], run[1]))
    deviation = np.repeat([1.0, 1.0, 0.2], [length - 1, near.shape[1], run.shape[1]])
    vector = small_noise(len(source), deviation, 0, planar=True).as_rotvec()
    vector[-run.shape[1] :, 2] += np.radians(25.0)
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [length - 1, near.shape[1] + run.shape[1]])
    drawn = Drawn.of(measured(truth, source, target, Rotation.from_rotvec(vector), kind=kind), None)
    problem = drawn.problem
    begun = mode_at(drawn, truth, [])
    held = Search(problem).polished(replace(begun.state, trusted=np.ones_like(begun.state.trusted)), "held")
    edge = problem.graph.view_graph_edge[problem.closure - problem.graph.num_segments]
    false_ones = problem.closure[edge >= len(source) - run.shape[1]]
    (proposal,) = (each for each in propose_rejected_runs(held) if (each.make().trusted[false_ones] == 0).all())
    assert proposal.predicted < proposal.slack == problem.limits.rival
    found = Search(problem).polished(proposal.make(), proposal.name)
    assert abs(found.cost - held.cost) < problem.limits.rival
    assert not held.is_turned_like(found.state)


def test_a_rival_is_told_of_though_it_is_the_likeliest() -> None:
    """What is published is the median, here the second."""
    graph, truth = laps({FIRST: 45.0})
    drawn = Drawn.of(graph, None)
    beyond = np.arange(len(truth)) > FIRST
    turned = truth * Rotation.from_rotvec(np.radians(45.0) * beyond[:, None] * [0, 0, 1])
    rivals = [mode_at(drawn, truth, [FIRST]), mode_at(drawn, turned, []), mode_at(drawn, turned, [])]
    turns = [np.zeros((3, drawn.problem.graph.num_nodes)) for _ in rivals]
    turns[0][2, -1] = np.radians(45.0)
    (warning,) = warnings_of(drawn.problem, rivals, np.array([0.4, 0.3, 0.3]), turns, 1)
    assert "nearly as likely (40 %)" in warning and "up to 45°" in warning


def test_nothing_is_proposed_where_nothing_slipped_and_nothing_is_false() -> None:
    graph, truth = laps({})
    mode = mode_at(Drawn.of(graph, None), truth, [])
    assert not list(propose_splits(mode))
    assert all(proposal.predicted > 0 for proposal in propose_rejected_runs(mode))
