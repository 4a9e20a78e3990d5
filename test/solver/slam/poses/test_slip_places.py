"""Where odometry slipped: closures leave several segments to rotations, of which places tell the right one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph, solve
from rotavg_ros.metrics import orientation_errors


def slipping_walk(seed: int) -> tuple[ViewGraph, torch.Tensor, torch.Tensor]:
    """A planar robot about a city's blocks, which slips once by 30 to 150°; 45 false closures of 150. Truth, which."""
    rng = np.random.default_rng(seed)
    at, back, corners = np.zeros(2), np.zeros(2), [np.zeros(2)]
    for _ in range(40):
        ways = [np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        ways = [way for way in ways if ((at + way >= 0) & (at + way < 6)).all() and (way != back).any()]
        back = -(way := ways[rng.integers(len(ways))])
        corners.append(at := at + way)
    path = np.array(corners) * 10.0
    place = np.linspace(0, 40, 600)
    position = np.stack([np.interp(place, np.arange(41), path[:, axis]) for axis in (0, 1)], axis=1)
    heading = np.unwrap(np.arctan2(*np.gradient(position, axis=0)[:, ::-1].T))
    source, target = np.arange(599), np.arange(1, 600)
    slip = rng.integers(150, 450)
    error = np.radians(0.3) * rng.normal(size=599)
    error[slip] += np.radians(rng.uniform(30, 150)) * rng.choice([-1, 1])
    near = cKDTree(position).query_pairs(3.0, output_type="ndarray")
    near = np.sort(near[np.abs(near[:, 0] - near[:, 1]) > 25], axis=1)
    near = near[rng.permutation(len(near))[:105]]
    far = np.sort(rng.integers(0, 600, (200, 2)), axis=1)
    far = far[(far[:, 1] - far[:, 0] > 25) & (np.linalg.norm(position[far[:, 0]] - position[far[:, 1]], axis=1) > 6)][
        :45
    ]
    source, target = (np.concatenate((odo, near[:, k], far[:, k])) for k, odo in ((0, source), (1, target)))
    is_false = np.arange(len(source)) >= 599 + len(near)
    error = np.concatenate((error, np.radians(1.0) * rng.normal(size=len(near)), rng.uniform(-np.pi, np.pi, len(far))))
    turn = heading[target] - heading[source] + error
    c, s = np.cos(heading[source]), np.sin(heading[source])
    step = position[target] - position[source]
    shift = np.stack([c * step[:, 0] + s * step[:, 1], -s * step[:, 0] + c * step[:, 1], 0 * c], axis=1)
    spread = np.where(np.arange(len(source)) < 599, 0.05 * np.linalg.norm(step, axis=1).clip(0.1), 0.1)
    shift[:, :2] += spread[:, None] * rng.normal(size=(len(source), 2))
    shift[is_false, :2] = rng.normal(size=(len(far), 2))
    kind = np.where(np.arange(len(source)) < 599, int(EdgeKind.ODOMETRY), int(EdgeKind.LOOP_CLOSURE))

    def as_quaternion(angle: np.ndarray) -> np.ndarray:
        return np.asarray(Rotation.from_rotvec(angle[:, None] * [[0.0, 0.0, 1.0]]).as_quat())

    turn = as_quaternion(turn)
    graph = ViewGraph.create(source, target, source_from_target=turn, num_nodes=600, kind=kind, translation=shift)
    truth = Rotation.from_quat(as_quaternion(heading)).inv().as_quat()
    return graph, torch.from_numpy(truth), torch.from_numpy(is_false)


@pytest.mark.large
@pytest.mark.parametrize(
    "seed",
    [
        5,  # the segment was no rival by rotations, for a slip moved to the next segments alone
        pytest.param(12, marks=pytest.mark.large),  # it was one, but begun at the places of another
    ],
)
def test_the_segment_is_found_and_no_good_closure_pays_for_it(seed: int) -> None:
    graph, truth, is_false = slipping_walk(seed)
    solution = solve(graph)
    errors = torch.rad2deg(orientation_errors(solution.body_from_world, truth))
    flagged = (solution.outlier_score > 0.5) & ~graph.is_odometry
    assert float(errors.mean()) < 2.0
    assert torch.equal(flagged, is_false)


def test_inside_the_segment_every_position_has_a_variance() -> None:
    """The slip bends the segment by far more than a linearisation about odometry holds for."""
    graph, _, _ = slipping_walk(5)
    uncertainty = solve(graph).position_uncertainty
    assert uncertainty is not None and bool((uncertainty[1:] > 0).all())
