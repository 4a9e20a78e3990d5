"""Slips that places know better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.slam import stages
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.search.mending import without_slips
from rotavg_ros.solver.slam.poses.search.settling import Rival, settled, settling
from rotavg_ros.solver.slam.posterior.em import polish, polish_fully
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.solve import search

from .test_rivals import found_of
from .test_slip_places import slipping_walk


def with_slips(rival: Rival, segments: list[int]) -> Rival:
    """The rival in which some sound segments are held to have slipped."""
    before = rival.mode
    trusted = before.state.trusted.copy()
    trusted[segments] = 0.0
    mode = Mode(before.problem, *polish(before.problem, replace(before.state, trusted=trusted)), "slips")
    return settled(replace(rival.pose.problem, mode=mode), PoseStart.at(rival.pose))


@torch.no_grad()
def test_slips_that_nothing_asks_for_are_taken_back() -> None:
    graph, translation, found = found_of("building: 30 % random", 6)
    rival = settling(estimate_poses(PoseProblem(graph, translation, found.modes[0])))
    assert len(rival.mode.slipped) == 0
    sound = rival.mode.problem.graph.num_segments
    invented = with_slips(rival, [sound // 4, sound // 2, 3 * sound // 4])
    assert len(invented.mode.slipped) == 3 and invented.cost > rival.cost + 10
    mended = without_slips(invented)
    assert len(mended.mode.slipped) == 0
    assert mended.cost == pytest.approx(rival.cost, abs=1.0)
    switched_off = replace(invented.mode, problem=replace(invented.mode.problem, without=frozenset({"mending"})))
    assert len(without_slips(replace(invented, mode=switched_off)).mode.slipped) == 3


@torch.no_grad()
def test_a_slip_that_closures_tell_of_stays() -> None:
    graph, _, is_false = slipping_walk(5)
    assert graph.translation is not None
    graph = graph.select_edges(~is_false)
    found = search(graph, load_network(SlamCleanNet), stages.bootstrap)
    mode = next(mode for mode in found.modes if len(mode.slipped))
    assert graph.translation is not None
    rival = settling(estimate_poses(PoseProblem(graph, graph.translation.numpy(), mode)))
    assert without_slips(rival) is rival
    invented = with_slips(rival, [int(mode.slipped[0]) // 2])
    assert np.array_equal(without_slips(invented).mode.slipped, rival.mode.slipped)


@torch.no_grad()
def test_polishing_ends_where_more_of_it_gains_nothing() -> None:
    """With all closures held good, the map bends until it fits half a hundred false ones; that takes many solves."""
    _, _, found = found_of("building: 30 % random", 6)
    mode = found.modes[0]
    state = replace(mode.state, trusted=np.ones_like(mode.state.trusted))
    once = polish(mode.problem, state)[1].total
    state, fully = polish_fully(mode.problem, state)
    assert fully.total < once - mode.problem.limits.slack
    assert polish(mode.problem, state)[1].total > fully.total - mode.problem.limits.slack
