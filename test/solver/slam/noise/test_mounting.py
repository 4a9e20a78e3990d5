"""A sensor of closures that is mounted otherwise than said."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver import Solution, solve
from rotavg_ros.solver.methods import DEFAULT_METHOD, without
from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.noise.mounting import between_axes, estimate_mountings, without_mounting
from rotavg_ros.solver.slam.posterior.calibration import Calibrated
from rotavg_ros.solver.slam.preparation import prepare_as_it_is
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# x right, y down, z forward, seen from a body whose x is forward and z up.
OPTICAL = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]]).as_rotvec()
vectors = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)


@cache
def drawn(kind: str, seed: int = 0) -> DrawnGraph:
    return next(one for one in KINDS if one.name == kind).drawn(seed)


@cache
def solved(kind: str, seed: int = 0) -> Solution:
    return solve(drawn(kind, seed).graph, profile="slam")


def mounted(graph: ViewGraph, vector: np.ndarray) -> ViewGraph:
    """Closures as a sensor states them that sits turned by ``vector``, rad."""
    return without_mounting(graph, -np.asarray(vector))


def error_deg(case: DrawnGraph, solution: Solution) -> float:
    errors = orientation_errors(solution.body_from_world, torch.from_numpy(case.body_from_world))
    return float(np.degrees(errors.numpy().mean()))


def mounting_of(solution: Solution) -> np.ndarray:
    assert isinstance(solution.memory, SlamMemory)
    calibration = solution.memory.calibration
    return np.zeros(3) if calibration is None else calibration.mounting


@given(vectors)
@settings(max_examples=20, deadline=None)
def test_what_was_put_in_is_taken_out(vector: np.ndarray) -> None:
    """Closures are conjugated, as scipy has it; odometry stays, bit by bit."""
    graph = drawn("hills: 30 % random").graph
    graph = replace(graph, translation=torch.randn(graph.num_edges, 3, dtype=torch.float64))
    seen, closures = mounted(graph, vector), ~graph.is_odometry
    turn = Rotation.from_rotvec(vector)
    expected = turn * Rotation.from_quat(graph.target_from_source[closures].numpy()) * turn.inv()
    assert (expected * Rotation.from_quat(seen.target_from_source[closures].numpy()).inv()).magnitude().max() < 1e-7
    assert graph.translation is not None and seen.translation is not None
    np.testing.assert_allclose(seen.translation[closures], turn.apply(graph.translation[closures].numpy()), atol=1e-12)
    assert torch.equal(seen.target_from_source[~closures], graph.target_from_source[~closures])
    assert torch.equal(seen.translation[~closures], graph.translation[~closures])
    again = without_mounting(seen, vector)
    assert rotations.angle_between(again.target_from_source, graph.target_from_source).max() < 1e-7
    torch.testing.assert_close(again.translation, graph.translation)


@given(vectors, st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3).map(np.array))
@settings(max_examples=20, deadline=None)
def test_what_is_left_is_added_after_what_was_taken_out(vector: np.ndarray, rest: np.ndarray) -> None:
    graph = drawn("hills: 30 % random").graph
    nothing = np.zeros(3)
    twice = Calibration(nothing, rest).taken_out_of(Calibration(nothing, vector).taken_out_of(graph))
    once = Calibration(nothing, vector).moved(np.concatenate((nothing, rest))).taken_out_of(graph)
    assert rotations.angle_between(once.target_from_source, twice.target_from_source).max() < 1e-7


@pytest.mark.parametrize("kind", ["hills: 30 % random", "sphere: 30 % random"])
def test_the_design_is_what_residuals_change_by(kind: str) -> None:
    """Numerically, on exact measurements, closures stated from either end."""
    case, step = drawn(kind), 1e-6
    graph, truth = case.graph, torch.from_numpy(case.body_from_world)
    is_back = ~graph.is_odometry & (torch.arange(graph.num_edges) % 2 == 0)
    source = torch.where(is_back, graph.target, graph.source)
    target = torch.where(is_back, graph.source, graph.target)
    exact = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    graph = replace(graph, source=source, target=target, target_from_source=exact)
    prepared = prepare_as_it_is(graph)
    design = Calibrated.of(graph, prepared, Calibration.none(), {"mounting"}).design
    assert np.abs(design[prepared.closure_graph.is_closure]).max() > 0.5
    for axis in range(3):
        turned = prepare_as_it_is(mounted(graph, step * np.eye(3)[axis])).closure_graph.residual
        np.testing.assert_allclose(design[:, :, axis], rotations.log(turned).numpy() / step, atol=1e-5)


@pytest.mark.parametrize("degrees", [25.0, 90.0, 170.0])
@pytest.mark.parametrize("kind", ["hills: 30 % random", "sphere: 50 % random", "building: 30 % random"])
def test_any_mounting_is_proposed(kind: str, degrees: float) -> None:
    """And upside down beside it, where both fit."""
    graph = drawn(kind).graph
    vector = np.radians(degrees) * np.array([0.6, -0.7, 0.39]) / np.linalg.norm([0.6, -0.7, 0.39])
    prepared = prepare_as_it_is(mounted(graph, vector))
    found = estimate_mountings(mounted(graph, vector), prepared.closure_graph, prepared.noise)
    off = [Rotation.from_rotvec(each) * Rotation.from_rotvec(vector).inv() for each in found]
    # Where a robot hardly tilts, turns tell where up goes, and little of what is about it.
    up = Rotation.from_rotvec(vector).apply([0, 0, 1])
    tilt = [np.arccos(np.clip(each.apply(up) @ up, -1, 1)) for each in off]
    angles = [each.magnitude() for each in off] if kind.startswith("sphere") else tilt
    assert 1 <= len(found) <= 2 and np.degrees(min(angles)) < 35


@given(vectors)
@settings(max_examples=20, deadline=None)
def test_between_two_axes_it_is_exact(vector: np.ndarray) -> None:
    """One of two leaves turns about one axis alone, with their signs; in space, or where one axis is shared, none."""
    graph = drawn("grid: 30 % random").graph
    seen = mounted(graph, vector)
    found = between_axes(seen)
    if np.linalg.norm(vector[:2]) < 1e-3:
        return
    assert len(found) == 2 and not between_axes(drawn("hills: 30 % random").graph)
    left = [without_mounting(seen, each) for each in found]
    assert all(each.rotation_components == 1 for each in left)
    apart = [rotations.angle_between(each.target_from_source, graph.target_from_source).max() for each in left]
    assert min(apart) < 1e-5 < max(apart)


def test_rejected_odometry_has_no_axis() -> None:
    """A step beside the chain that a user has rejected, about any axis, does not tilt that of all others."""
    seen = mounted(drawn("grid: 30 % random").graph, np.radians([30.0, 0.0, 0.0]))
    more = seen.select_edges(torch.cat((torch.arange(seen.num_edges), seen.is_odometry.nonzero()[:3, 0])))
    measured, label = more.target_from_source.clone(), more.label.clone()
    measured[-3:], label[-3:] = rotations.exp(torch.tensor([2.0, 1.0, 1.0]).double()), EdgeLabel.REJECTED
    found = between_axes(replace(more, target_from_source=measured, label=label))
    np.testing.assert_allclose(found, between_axes(seen), rtol=0, atol=1e-6)


VECTORS = {"little": np.radians([8.0, -9.0, 6.0]), "more": np.radians([10.0, 5.0, -25.0]), "camera": OPTICAL}
# These two by default.
ALWAYS = [("hills: 30 % random", "camera")]


@pytest.mark.parametrize(
    ("kind", "mounting"),
    [
        pytest.param(kind, mounting, marks=() if (kind, mounting) in ALWAYS else pytest.mark.large)
        for kind in ("hills: 30 % random", "sphere: 30 % random", "hills: gyroscope bias, 30 % random")
        for mounting in VECTORS
    ],
)
def test_the_answer_is_what_it_would_be(kind: str, mounting: str) -> None:
    vector = VECTORS[mounting]
    case, as_said = drawn(kind, 1 if kind.startswith("hills: g") else 0), solved(kind, 1 if "gyro" in kind else 0)
    graph = mounted(case.graph, vector)
    solution = solve(graph, profile="slam")
    assert np.degrees(np.linalg.norm(mounting_of(as_said))) == 0
    assert error_deg(case, solution) < 1.1 * error_deg(case, as_said) + 0.05
    assert ((solution.outlier_score > 0.5) != (as_said.outlier_score > 0.5)).sum() <= 2
    off = Rotation.from_rotvec(mounting_of(solution)) * Rotation.from_rotvec(vector).inv()
    assert np.degrees(off.magnitude()) < 2.5
    blind = solve(graph, profile="slam", method=without("mounting"))
    assert error_deg(case, blind) > 1.25 * error_deg(case, solution)


@pytest.mark.large
def test_a_camera_on_a_robot_in_the_plane() -> None:
    """Its odometry turns about z alone; with translations, which do not tell where the camera looks."""
    case = drawn("grid: 30 % random")
    as_said = solved("grid: 30 % random")
    solution = solve(mounted(case.graph, OPTICAL), profile="slam")
    assert error_deg(case, solution) == pytest.approx(error_deg(case, as_said), abs=0.02)
    assert torch.equal(solution.outlier_score > 0.5, as_said.outlier_score > 0.5)
    (note,) = (text for text in solution.warnings if "mounted" in text)
    assert "neurora~mounting" in note and "edge_sensor_orientations" in note and "axis that all rotations share" in note


def test_the_note_says_what_the_nodes_parameter_wants() -> None:
    """The sensor's orientation in the body's frame, xyzw: a camera's is -.5, .5, -.5, .5."""
    case = drawn("hills: 30 % random")
    solution = solve(mounted(case.graph, OPTICAL), profile="slam")
    (note,) = (text for text in solution.warnings if "mounted" in text)
    stated = [float(word) for word in note.split("x, y, z, w = ")[1].split(".  ")[0].split(". The")[0].split(", ")]
    body_from_sensor = Rotation.from_quat(stated)
    assert np.degrees((body_from_sensor * Rotation.from_rotvec(OPTICAL)).magnitude()) < 2.5
    assert np.degrees((Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]).inv() * body_from_sensor).magnitude()) < 2.5


@pytest.mark.parametrize(
    "kind",
    [
        "hills: 80 % random",
        "hills: 30 % near misses in groups",
        "hills: drift in yaw alone",
        *(
            pytest.param(kind, marks=pytest.mark.large)
            for kind in (
                "sphere: gyroscope bias, 30 % random",
                "sphere: precisions off by factors",
                "hills: odometry worse in turns",
            )
        ),
        "hills: 15 closures",
    ],
)
def test_none_is_invented(kind: str) -> None:
    solution = solved(kind)
    assert not mounting_of(solution).any() and not any("mounted" in text for text in solution.warnings)
    blind = solve(drawn(kind).graph, profile="slam", method=without("mounting"))
    assert torch.equal(solution.body_from_world, blind.body_from_world)
    assert torch.equal(solution.outlier_score, blind.outlier_score)


@pytest.mark.large
def test_the_bodys_axes_do_not_matter() -> None:
    """All bodies turned alike: so is the mounting."""
    graph, turn = (
        mounted(drawn("hills: 30 % random").graph, np.radians([14.0, 8.0, -13.0])),
        np.radians([40.0, 70.0, 10]),
    )
    frame = rotations.exp(torch.from_numpy(turn)).expand(graph.num_edges, 4)
    turned = rotations.multiply(rotations.multiply(frame, graph.target_from_source), rotations.inverse(frame))
    one, other = (
        mounting_of(solve(each, profile="slam", method=DEFAULT_METHOD))
        for each in (graph, replace(graph, target_from_source=turned))
    )
    np.testing.assert_allclose(Rotation.from_rotvec(turn).apply(one), other, atol=np.radians(0.5))


def test_inverted_closures_in_the_plane_are_no_mounting() -> None:
    """They would be those of a sensor upside down; a warning says what they are."""
    graph = drawn("grid: 30 % random").graph
    inverted = torch.where(
        graph.is_odometry[:, None], graph.target_from_source, rotations.inverse(graph.target_from_source)
    )
    solution = solve(replace(graph, target_from_source=inverted), profile="slam")
    assert not mounting_of(solution).any()
    assert any("inverted" in text for text in solution.warnings)


def test_one_closure_that_turns_tells_no_mounting() -> None:
    """False, about another axis than odometry's; the others see a place again from where it was seen before."""
    count = 60
    yaw = np.radians(12.0 * np.arange(count) + np.cumsum(np.random.default_rng(8).normal(0, 1, count)))
    world_from_body = Rotation.from_rotvec(yaw[:, None] * [0, 0, 1])
    older, newer = np.arange(0, 30, 3), np.arange(30, 60, 3)
    steps = (world_from_body[:-1].inv() * world_from_body[1:]).inv().as_quat()
    same, false = np.tile([0.0, 0.0, 0.0, 1.0], (len(older), 1)), Rotation.from_rotvec([[0, 1.5, 0]]).as_quat()
    graph = ViewGraph.create(
        np.concatenate((np.arange(count - 1), older, [20])),
        np.concatenate((np.arange(1, count), newer, [58])),
        np.concatenate((steps, same, false)),
        num_nodes=count,
        kind=[0] * (count - 1) + [1] * 11,
    )
    solution = solve(graph, profile="slam")
    assert not mounting_of(solution).any()
    assert (solution.outlier_score > 0.5).nonzero()[:, 0].tolist() == [graph.num_edges - 1]


def test_rejected_closures_tell_nothing() -> None:
    graph = mounted(drawn("hills: 30 % random").graph, np.radians([20.0, -30.0, 10.0]))
    label = torch.where(graph.is_odometry, graph.label, torch.full_like(graph.label, int(EdgeLabel.REJECTED)))
    solution = solve(replace(graph, label=label), profile="slam")
    assert not mounting_of(solution).any() and not any("mounted" in text for text in solution.warnings)


@pytest.mark.parametrize(
    "kind",
    [
        "hills: 30 % random",
        *(pytest.param(kind, marks=pytest.mark.large) for kind in ("sphere: 30 % random", "grid: 30 % random")),
    ],
)
def test_a_few_degrees_are_told_and_nothing_is_turned(kind: str) -> None:
    """Odometry's axes may be at fault as well; what the note says to set is right if they are not."""
    case, vector = drawn(kind), np.radians([3.0, -3.5, 2.0])
    graph = mounted(case.graph, vector)
    solution = solve(graph, profile="slam")
    assert not mounting_of(solution).any()
    blind = solve(graph, profile="slam", method=without("mounting"))
    assert torch.equal(solution.body_from_world, blind.body_from_world)
    (note,) = (text for text in solution.warnings if "axes that differ" in text)
    assert not any("axes that differ" in text for text in (*blind.warnings, *solved(kind).warnings))
    stated = [float(word) for word in note.split("x, y, z, w = ")[1].split(":")[0].split(", ")]
    told = without_mounting(graph, -Rotation.from_quat(stated).as_rotvec())
    bent, usual = error_deg(case, solution), error_deg(case, solved(kind))
    assert bent > 1.3 * usual
    # Four digits of a quaternion leave a robot in the plane a little out of it, where noise is another.
    assert error_deg(case, solve(told, profile="slam")) < max(1.1 * usual + 0.05, 0.5 * bent)
