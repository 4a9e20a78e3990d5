"""Is the stated uncertainty right? Monte Carlo over pose graphs whose noise is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.solver import Solution, solve
from rotavg_ros.view_graph import ViewGraph

# Noise per step and per closure, degrees per component: odometry that is good, middling and worse than the closures.
NOISE_DEG = ((0.1, 1.0), (0.5, 1.0), (1.5, 0.5))

# Least stated standard deviation that is used, rad, so that a claim of exactness does not make the average infinite.
_SMALLEST_STATED = np.radians(1e-3)


@dataclass(frozen=True)
class UncertaintyCheck:
    """Errors over stated standard deviations.

    Attributes:
        step_deg, closure_deg: standard deviation of the noise of each component.
        normalized_error: root mean square, over draws, nodes and components; 1 if the uncertainty is right.
        within_one, within_two: share of components within one and two standard deviations (0.683, 0.954 if Gaussian).
    """

    graph_name: str
    step_deg: float
    closure_deg: float
    normalized_error: float
    within_one: float
    within_two: float


def _as_robots_graph(graph: ViewGraph) -> Solution:
    return solve(graph, profile="slam")


def check(
    name: str,
    graph_file: GraphFile,
    draws: int,
    seed: int,
    solver: Callable[[ViewGraph], Solution] = _as_robots_graph,
) -> Iterator[UncertaintyCheck]:
    """Put known noise on a graph's edges, solve, and compare errors with what was stated, for several noise levels.

    Args:
        graph_file: gives the edges; its clean solution is the truth.
        draws: solves per noise level.
        solver: states an uncertainty.
    """
    graph = graph_file.graph
    truth = least_squares(graph, np.ones(graph.num_edges, dtype=bool))
    components = 1 if graph_file.planar else 3
    rng = np.random.default_rng((seed, 0xE1105))
    for step_deg, closure_deg in NOISE_DEG:
        sigma = np.radians(np.where(graph.is_odometry.numpy(), step_deg, closure_deg))
        normalized = []
        for _ in range(draws):
            solution = solver(_noisy(graph, truth, sigma, components, rng))
            found = (solution.body_from_world, solution.component, solution.uncertainty)
            normalized.append(normalized_errors(*found, truth, components))
        values = np.abs(np.concatenate(normalized))
        yield UncertaintyCheck(
            name,
            step_deg,
            closure_deg,
            float(np.sqrt((values**2).mean())),
            float((values < 1).mean()),
            float((values < 2).mean()),
        )


def normalized_errors(
    estimate: torch.Tensor, component: torch.Tensor, stated: torch.Tensor, truth: torch.Tensor, components: int
) -> np.ndarray:
    """Errors relative to each component's first node, over their stated standard deviations; first nodes left out.

    Args:
        estimate, truth: ``(N, 4)`` body_from_world.
        component: ``(N,)`` connected component of every node.
        stated: ``(N,)`` rad per component of the rotation vector.
        components: 1 for the yaw of planar graphs, or all 3.

    Returns:
        The values of all nodes and components in one row.
    """
    is_free = ~_is_first(component)
    error = _error(estimate, truth, component)[is_free, 3 - components :]
    return np.asarray(error / np.maximum(stated.numpy()[is_free, None], _SMALLEST_STATED)).ravel()


def table(title: str, checks: Sequence[UncertaintyCheck]) -> Table:
    """Errors over what was stated of them."""
    figures = ("graph_name", "step_deg", "closure_deg", "normalized_error", "within_one", "within_two")
    columns = (
        Column("graph"),
        Column("noise per step °", ".1f"),
        Column("per closure °", ".1f"),
        Column("error ÷ stated", ".2f"),
        Column("within 1σ", ".3f"),
        Column("within 2σ", ".3f"),
    )
    rows = tuple(tuple(getattr(check, figure) for figure in figures) for check in checks)
    return Table(
        title, columns, rows, ("Root mean square over nodes and draws of known noise; 1, 0.683, 0.954 if right.",)
    )


def _noisy(
    graph: ViewGraph, truth: torch.Tensor, sigma: np.ndarray, components: int, rng: np.random.Generator
) -> ViewGraph:
    """The same edges, measured with noise of ``sigma`` ``(M,)`` rad per component (the last only, or all three).

    Their translations, which were measured with other rotations, are left out.
    """
    vector = np.zeros((graph.num_edges, 3))
    vector[:, 3 - components :] = sigma[:, None] * rng.normal(size=(graph.num_edges, components))
    relative = rotations.multiply(truth[graph.target], rotations.inverse(truth[graph.source]))
    measured = Rotation.from_rotvec(vector) * Rotation.from_quat(relative.numpy())
    quaternions = torch.from_numpy(measured.as_quat(canonical=True))
    return replace(
        graph, target_from_source=quaternions, precision=torch.full_like(graph.precision, torch.nan), translation=None
    )


def _is_first(component: torch.Tensor) -> np.ndarray:
    """``(N,)`` bool: the first node of a component, whose orientation is exact by definition."""
    is_first = np.zeros(len(component), dtype=bool)
    is_first[np.unique(component.numpy(), return_index=True)[1]] = True
    return is_first


def _error(estimate: torch.Tensor, truth: torch.Tensor, component: torch.Tensor) -> np.ndarray:
    """Rotation vectors ``(N, 3)`` from truth to estimate in the world frame, both rooted at each first node."""
    first = torch.from_numpy(np.unique(component.numpy(), return_index=True)[1])[component]
    rooted = rotations.multiply(truth, rotations.inverse(truth[first]))
    rooted_estimate = rotations.multiply(estimate, rotations.inverse(estimate[first]))
    return rotations.log(rotations.multiply(rotations.inverse(rooted), rooted_estimate)).numpy()
