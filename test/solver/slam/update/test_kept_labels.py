"""Labels that outlive a solve lead to its answer, without a search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.solver import KeptLabels, Solution, solve
from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

from .test_conditioned import drawn as simulated
from .test_memory import drawn, grown, until


def labels_of(solution: Solution) -> KeptLabels:
    assert isinstance(solution.memory, SlamMemory)
    labels = solution.memory.labels
    assert labels is not None
    return labels


def as_read(labels: KeptLabels, graph: ViewGraph) -> KeptLabels:
    return KeptLabels.of_arrays(graph, {name: values.copy() for name, values in labels.arrays().items()})


def apart_deg(one: Solution, other: Solution) -> float:
    turn = rotations.multiply(one.body_from_world, rotations.inverse(other.body_from_world[: len(one.body_from_world)]))
    return float(torch.rad2deg(rotations.angle(turn)).max())


@pytest.mark.parametrize(
    "kind",
    [
        "building: 30 % random",
        "hills: gyroscope bias, 30 % random",
        pytest.param("building: locatable slips, 30 % random", marks=pytest.mark.large),
        "hills: 30 % near misses in groups",
        "sphere: uneven odometry",
    ],
)
def test_they_lead_to_the_same_answer(kind: str) -> None:
    graph = drawn(kind, 1).graph
    first = solve(graph, profile="slam")
    labels = as_read(labels_of(first), graph)
    again = solve(graph, profile="slam", warm_start=first.body_from_world, memory=labels)
    assert set(again.stage_seconds) == {"update"} and not again.is_anew
    assert ((first.outlier_score > 0.5) != (again.outlier_score > 0.5)).sum() <= 2
    # What a rival labelling had a share in has none in a single one.
    assert apart_deg(first, again) < 3 * float(torch.rad2deg(first.uncertainty).max())
    assert again.work < 0.3 * first.work


@pytest.mark.parametrize("translations", [False, pytest.param(True, marks=pytest.mark.large)])
def test_a_graph_that_has_grown_goes_on_from_them(translations: bool) -> None:
    whole, _ = simulated(translations=translations, planar=True)
    before = until(whole, whole.num_nodes - 10)
    first = solve(before, profile="slam")
    ordered = until(whole, whole.num_nodes)
    labels = as_read(labels_of(first), ordered)
    answer = solve(ordered, profile="slam", warm_start=grown(ordered, first), memory=labels)
    assert set(answer.stage_seconds) == {"update"} and (answer.position is not None) == translations
    cold = solve(ordered, profile="slam")
    assert apart_deg(answer, cold) < 3 * float(torch.rad2deg(cold.uncertainty).max())
    # … and so on as from any other memory.
    assert isinstance(answer.memory, SlamMemory) and labels_of(answer).by_places is translations
    more = solve(ordered, profile="slam", warm_start=answer.body_from_world, memory=answer.memory, anew=True)
    assert more.is_anew and torch.equal(more.body_from_world, cold.body_from_world)


def test_what_does_not_fit_is_solved_from_nothing() -> None:
    graph = drawn("building: 15 closures", 1).graph
    first = solve(graph, profile="slam")
    labels, start = labels_of(first), first.body_from_world

    def goes_on(kept: KeptLabels, on: ViewGraph = graph) -> bool:
        return set(solve(on, profile="slam", warm_start=start, memory=kept).stage_seconds) == {"update"}

    assert goes_on(labels)
    others = replace(graph, target_from_source=rotations.inverse(graph.target_from_source))
    assert not goes_on(replace(labels, graph=others))
    assert not goes_on(replace(labels, pose_noise=np.ones(7)))
    assert not goes_on(replace(labels, noise=labels.noise[:-1]))  # of another version of the solver
    label = graph.label.clone()
    label[-1] = EdgeLabel.REJECTED
    assert not goes_on(labels, replace(graph, label=label))


@pytest.mark.parametrize("axis", [None, np.array([0.0, 0.6, 0.8])])
def test_the_axis_of_a_bias_is_kept(axis: np.ndarray | None) -> None:
    """Without it a bias about the vertical alone had three components, and F was 3.5 nats too large."""
    graph = drawn("building: 15 closures", 1).graph
    first = solve(graph, profile="slam")
    assert isinstance(first.memory, SlamMemory)
    found = Calibration(np.array([0.0, 6e-4, 8e-4]), np.zeros(3), axis)
    labels = as_read(labels_of(replace(first, memory=replace(first.memory, calibration=found))), graph)
    answer = solve(graph, profile="slam", warm_start=first.body_from_world, memory=labels)
    assert isinstance(answer.memory, SlamMemory) and answer.memory.calibration is not None
    np.testing.assert_array_equal(answer.memory.calibration.vector, found.vector)
    np.testing.assert_equal(answer.memory.calibration.axis, axis)


@pytest.mark.parametrize("name", ["trusted", "noise", "calibration", "bias_axis", "places", "pose_noise", "search"])
def test_arrays_that_are_none_of_theirs(name: str) -> None:
    graph = drawn("building: 15 closures", 1).graph
    count = graph.num_edges
    none = np.zeros(0)
    labels = KeptLabels(graph, np.ones(count), np.ones(10), none, none, np.ones((5, count)), np.ones(7), np.ones(3))
    arrays = labels.arrays()
    assert KeptLabels.of_arrays(graph, arrays).arrays().keys() == arrays.keys()
    with pytest.raises(KeyError):
        KeptLabels.of_arrays(graph, {key: value for key, value in arrays.items() if key != name})
    with pytest.raises(ValueError, match="fit no graph"):
        KeptLabels.of_arrays(graph, arrays | {name: np.ones((count + 1, 2))})
