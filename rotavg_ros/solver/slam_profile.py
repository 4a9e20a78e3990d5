"""The SLAM profile: contract the odometry, clean, bootstrap, refine, expand; or go on from the last solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver import slam_preparation, slam_refinement, slam_stages
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.methods import DEFAULT_METHOD, NETWORK_METHODS, Method
from rotavg_ros.solver.profile import Estimate, Networks, Stopwatch
from rotavg_ros.solver.repeated_edges import first_of_each
from rotavg_ros.solver.slam_memory import SlamMemory
from rotavg_ros.solver.slam_passes import Verdicts
from rotavg_ros.view_graph import ViewGraph


def solve_slam(
    graph: ViewGraph,
    method: Method,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: Networks,
    watch: Stopwatch,
) -> Estimate:
    """One method on a graph that lives on the CPU; what it states more than once counts once.

    Args:
        refinement_steps: passes at most, 0 for none; None: as many as there may be.
        warm_start: ``(N, 4)`` body_from_world instead of the tree's.
    """
    repeats = first_of_each(graph)
    if repeats is None:
        return _solve_once(graph, method, refinement_steps, warm_start, networks, watch)
    first, says_as = (torch.from_numpy(edges) for edges in repeats)
    estimate = _solve_once(graph.select_edges(first), method, refinement_steps, warm_start, networks, watch)
    return replace(estimate, outlier_score=estimate.outlier_score[says_as], memory=None)


def _solve_once(
    graph: ViewGraph,
    method: Method,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: Networks,
    watch: Stopwatch,
) -> Estimate:
    """The same for a graph without repetitions."""
    with watch.stage("contract"):
        prepared = slam_preparation.prepare(graph, scale_estimation=method.scale_estimation)
    with watch.stage("clean"):
        network = networks.load("slam-clean-net") if method.clean else None
        cleaned = slam_stages.clean(network, prepared, graph.label)
    with watch.stage("bootstrap"):
        if warm_start is not None:
            correction = prepared.closure_graph.corrections(warm_start.double())
        elif method.tree_start:
            correction = slam_stages.bootstrap(prepared, cleaned)
        else:
            correction = rotations.identity(prepared.closure_graph.num_nodes)
    steps = (slam_refinement.MAX_PASSES if method.refine else 0) if refinement_steps is None else refinement_steps
    if steps > 0:
        with watch.stage("refine"):
            estimate = slam_stages.refine(
                prepared,
                cleaned,
                correction,
                steps,
                scale_estimation=method.scale_estimation,
                slip_search=method.slip_search,
            )
        with watch.stage("expand"):
            closure_graph = prepared.closure_graph
            variance = closure_graph.variance(estimate.samples, estimate.stated_step_variance)
            is_default = method is NETWORK_METHODS[DEFAULT_METHOD]
            memory = SlamMemory.of(graph, prepared, cleaned, estimate, variance) if is_default else None
            return _slam_estimate(closure_graph, estimate, variance, memory)
    with watch.stage("expand"):
        score = slam_stages.outlier_scores(prepared.closure_graph, 1 - cleaned.inlier_probability)
        orientations = prepared.closure_graph.orientations(correction)
    return Estimate(orientations, torch.from_numpy(score), torch.full((graph.num_nodes,), torch.nan))


def _slam_estimate(
    graph: ClosureGraph, verdicts: Verdicts, variance: np.ndarray, memory: SlamMemory | None
) -> Estimate:
    """From the closure graph's nodes and edges to the view-graph's, of whose nodes ``variance`` ``(N,)`` is."""
    return Estimate(
        graph.orientations(verdicts.correction),
        torch.from_numpy(slam_stages.outlier_scores(graph, verdicts.outlier_probability)),
        torch.from_numpy(variance),
        memory,
    )


def update_slam(
    graph: ViewGraph, memory: SlamMemory, warm_start: Tensor, networks: Networks, watch: Stopwatch
) -> Estimate | None:
    """The SLAM profile's solve of a graph that has grown by a few edges; None if the whole of it is due."""
    with watch.stage("update"):
        updated = memory.updated(graph, networks.load("slam-clean-net"), warm_start.double())
        return None if updated is None else _slam_estimate(*updated)
