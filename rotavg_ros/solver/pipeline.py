"""The solve: clean → bootstrap → fine-tune → refine."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.errors import UserError
from rotavg_ros.solver import refinement, slam_refinement
from rotavg_ros.solver.agreement import agreement_pairs
from rotavg_ros.solver.closure_graph import contract
from rotavg_ros.solver.noise_model import discrepancies, estimate_noise, judge_by_chain
from rotavg_ros.solver.solution import Solution
from rotavg_ros.solver.spanning_tree import compose_orientations, minimum_spanning_forest, shortest_path_forest
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

METHODS = ("neurora", "spt")
PROFILES = ("auto", "slam", "sfm")
DEVICES = ("auto", "cpu", "cuda")

# Odometry first: no number of steps is worth a closure.
_CLOSURE_COST = 1e6


@dataclass
class _Stopwatch:
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def solve(
    graph: ViewGraph,
    *,
    method: str = "neurora",
    profile: str = "auto",
    device: str = "auto",
    refinement_steps: int | None = None,
    warm_start: Tensor | None = None,
) -> Solution:
    """Absolute orientations and outlier scores of a view-graph; every connected component by itself.

    Args:
        method: one of :data:`METHODS`.
        profile: "slam" for odometry chains with loop closures, "sfm" for unordered view-graphs, "auto": "slam" if any
            edge is odometry.
        device: "cpu", "cuda" or "auto".
        refinement_steps: refinement steps at most, 0 for none; default: the profile's own number.
        warm_start: ``(N, 4)`` body_from_world of an earlier solution to start from.

    Raises:
        UserError: an option outside its choices, or a start of the wrong shape.
    """
    _check_choice("method", method, METHODS)
    _check_choice("profile", profile, PROFILES)
    _check_choice("device", device, DEVICES)
    if refinement_steps is not None and refinement_steps < 0:
        raise UserError(f"refinement steps must not be negative, got {refinement_steps}")
    if warm_start is not None and tuple(warm_start.shape) != (graph.num_nodes, 4):
        raise UserError(f"the warm start has shape {tuple(warm_start.shape)}, the graph needs ({graph.num_nodes}, 4)")
    if profile == "auto":
        profile = "slam" if bool(graph.is_odometry.any()) else "sfm"
    graph = graph.to("cpu")
    watch = _Stopwatch()
    if profile == "slam":
        result = _solve_slam(graph, method, refinement_steps, watch)
    else:
        result = _solve_sfm(graph, method, refinement_steps, watch)
    orientations, score, variance = result
    component = graph.components()
    orientations = _root_at_identity(orientations, component)
    score = torch.where(graph.label == EdgeLabel.ACCEPTED, 0.0, score)
    score = torch.where(graph.label == EdgeLabel.REJECTED, 1.0, score)
    return Solution(orientations, score, component, variance.sqrt(), watch.seconds, method, profile, "cpu")


def _solve_slam(
    graph: ViewGraph, method: str, refinement_steps: int | None, watch: _Stopwatch
) -> tuple[Tensor, Tensor, Tensor]:
    with watch.stage("bootstrap"):
        forest = minimum_spanning_forest(graph, torch.where(graph.is_odometry, 1.0, _CLOSURE_COST))
        closure_graph = contract(graph, forest)
    with watch.stage("clean"):
        closure = closure_graph.is_closure
        square = (rotations.log(closure_graph.residual) ** 2).sum(dim=1).numpy()
        path_steps = closure_graph.path_steps[closure]
        pairs = agreement_pairs(closure_graph)
        noise = estimate_noise(discrepancies(square[closure], path_steps, pairs), _components(graph))
        inlier_probability = np.ones(len(square))
        inlier_probability[closure] = expit(judge_by_chain(noise, square[closure], path_steps) + noise.prior_log_odds)
    with watch.stage("refine"):
        steps = slam_refinement.MAX_PASSES if refinement_steps is None else refinement_steps
        correction = rotations.identity(closure_graph.num_nodes)
        variance = np.full(graph.num_nodes, np.nan)
        if method != "spt" and steps > 0:
            log_odds = np.zeros(len(square))
            label = graph.label.numpy()[closure_graph.view_graph_edge]
            log_odds[closure_graph.num_segments :] = np.select(
                [label == EdgeLabel.ACCEPTED, label == EdgeLabel.REJECTED], [np.inf, -np.inf], 0.0
            )
            estimate = slam_refinement.refine(
                closure_graph, correction, inlier_probability, noise, log_odds=log_odds, max_passes=steps
            )
            correction, inlier_probability = estimate.correction, estimate.inlier_probability
            variance = estimate.variance[closure_graph.above]
    score = torch.from_numpy(1 - closure_graph.edge_values(inlier_probability))
    return closure_graph.orientations(correction), score, torch.from_numpy(variance)


def _solve_sfm(
    graph: ViewGraph, method: str, refinement_steps: int | None, watch: _Stopwatch
) -> tuple[Tensor, Tensor, Tensor]:
    with watch.stage("bootstrap"):
        forest = shortest_path_forest(graph)
        orientations = compose_orientations(forest, graph)
    steps = (0 if method == "spt" else 20) if refinement_steps is None else refinement_steps
    with watch.stage("refine"):
        prior = torch.where(graph.label == EdgeLabel.REJECTED, 0.0, 1.0)
        orientations, angle = refinement.refine(graph, orientations, prior, forest.roots, steps)
    score = torch.sigmoid(torch.from_numpy(angle - np.radians(20)) / np.radians(3))
    return orientations, score, torch.full((graph.num_nodes,), torch.nan, dtype=torch.float64)


def _components(graph: ViewGraph) -> int:
    """1 if all measured rotations share one axis (planar motion), else 3."""
    vectors = rotations.log(graph.target_from_source)
    spread = torch.linalg.eigvalsh(vectors.T @ vectors)
    return 1 if float(spread[1]) <= 1e-10 * float(spread[2]) else 3


def _root_at_identity(body_from_world: Tensor, component: Tensor) -> Tensor:
    """The same orientations in the gauge where the first node of every component is the identity."""
    first = torch.full((int(component.max()) + 1 if len(component) else 0,), len(component))
    first = first.scatter_reduce(0, component, torch.arange(len(component)), "amin")
    gauge = rotations.inverse(body_from_world[first])[component]
    return rotations.normalize(rotations.multiply(body_from_world, gauge))


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UserError(f"unknown {name} {value!r}; choose from {', '.join(choices)}")
