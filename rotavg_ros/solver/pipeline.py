"""The solve, as the paper has it and one stage more: clean → bootstrap → fine-tune → refine (NeuRoRA, §4)."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.errors import UserError
from rotavg_ros.solver import devices, refinement, sfm_refinement, sfm_stages, slam_refinement, slam_stages
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.devices import DEVICES
from rotavg_ros.solver.methods import BASELINES, DEFAULT_METHOD, METHODS, NETWORK_METHODS, Method
from rotavg_ros.solver.network_store import load_network
from rotavg_ros.solver.parallel import workers
from rotavg_ros.solver.slam_memory import SlamMemory
from rotavg_ros.solver.slam_refinement import SlamEstimate
from rotavg_ros.solver.solution import Solution
from rotavg_ros.solver.tuning import tune
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

PROFILES = ("auto", "slam", "sfm")
# A graph of more edges is worth measuring what tiles this machine likes.
_TUNING_PAYS = 200_000
# The noise that makes an edge an outlier, in radians.
_OUTLIER_ANGLE = {"sfm": sfm_stages.OUTLIER_ANGLE, "slam": slam_refinement.OUTLIER_ANGLE}


@dataclass(frozen=True)
class _Estimate:
    """What a profile's solve gives: orientations in any gauge, scores, variance in rad² (NaN: unknown)."""

    body_from_world: Tensor
    outlier_score: Tensor
    variance: Tensor
    memory: SlamMemory | None = None


@dataclass(frozen=True)
class _Networks:
    """Where the networks run, and the folder that has those of the user's."""

    device: str
    folder: Path | None

    def load(self, name: str) -> Any:
        if self.folder is not None and (self.folder / f"{name}.safetensors").exists():
            return load_network(name, self.device, self.folder)
        return load_network(name, self.device)


@dataclass
class _Stopwatch:
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@torch.no_grad()
def solve(
    graph: ViewGraph,
    *,
    method: str = DEFAULT_METHOD,
    profile: str = "auto",
    device: str = "auto",
    refinement_steps: int | None = None,
    warm_start: Tensor | None = None,
    memory: SlamMemory | None = None,
    weights: Path | None = None,
) -> Solution:
    """Absolute orientations and outlier scores of a view-graph; every connected component by itself.

    Args:
        method: one of :data:`METHODS`, or several joined by "+", of which each starts from the answer of the one
            before.
        profile: "slam" for odometry chains with loop closures, "sfm" for unordered view-graphs, "auto": "slam" if any
            edge is odometry.
        device: where the SfM profile runs, whole: "cpu", "cuda", or "auto" (a GPU if torch finds one). Where there is
            none that works, or it has too little memory, the CPU does it, which is logged. The SLAM profile and the
            baselines are small and sparse; they run on the CPU.
        refinement_steps: refinement steps at most, 0 for none; default: the method's and profile's own number.
        warm_start: ``(N, 4)`` body_from_world of an earlier solution to start from; the SLAM profile then takes fewer
            refinement steps.
        memory: that of the earlier solution by the same method, if the graph has only grown since; with it a warm start
            of a large SLAM graph judges the new edges and goes on from all other verdicts. Now and then, and where too
            much has changed, everything is judged anew.
        weights: folder of networks trained with ``rotavg train``; what it lacks comes from the package.

    Raises:
        UserError: an option outside its choices, or a start of the wrong shape.
    """
    names = method.split("+")
    for name in names:
        _check_choice("method", name, METHODS)
    _check_choice("profile", profile, PROFILES)
    _check_choice("device", device, DEVICES)
    if refinement_steps is not None and refinement_steps < 0:
        raise UserError(f"refinement steps must not be negative, got {refinement_steps}")
    if warm_start is not None and tuple(warm_start.shape) != (graph.num_nodes, 4):
        raise UserError(f"the warm start has shape {tuple(warm_start.shape)}, the graph needs ({graph.num_nodes}, 4)")
    if profile == "auto":
        profile = "slam" if bool(graph.is_odometry.any()) else "sfm"
    where = devices.choose(device) if profile == "sfm" and all(name in NETWORK_METHODS for name in names) else "cpu"
    graph = graph.to("cpu")
    job = _Job(profile, names, refinement_steps, warm_start, graph.components(), memory)
    try:
        estimate, seconds = _run(job, graph, _Networks(where, weights))
    except devices.GPU_ERRORS as error:
        if where == "cpu":
            raise
        devices.fall_back(error)
        where = "cpu"
        estimate, seconds = _run(job, graph, _Networks(where, weights))
    score = torch.where(graph.label == EdgeLabel.ACCEPTED, 0.0, estimate.outlier_score.cpu())
    score = torch.where(graph.label == EdgeLabel.REJECTED, 1.0, score)
    return Solution(
        _root_at_identity(estimate.body_from_world.cpu(), job.component),
        score,
        job.component,
        estimate.variance.cpu().double().sqrt(),
        seconds,
        method,
        profile,
        where,
        estimate.memory,
    )


@dataclass(frozen=True)
class _Job:
    """What to do with a graph, whose ``component`` ``(N,)`` of every node is known."""

    profile: str
    names: list[str]
    refinement_steps: int | None
    warm_start: Tensor | None
    component: Tensor
    memory: SlamMemory | None

    @property
    def may_update(self) -> bool:
        """Whether an earlier solution's memory may be gone on from."""
        return self.profile == "slam" and self.names == [DEFAULT_METHOD] and self.refinement_steps is None

    @property
    def last_steps(self) -> int | None:
        """Refinement steps of the last link of the method; None: its own number."""
        method = NETWORK_METHODS.get(self.names[-1])
        refines = method is not None and method.refine
        if self.refinement_steps is None and refines and self.profile == "slam" and self.warm_start is not None:
            return slam_refinement.WARM_PASSES
        return self.refinement_steps


def _run(job: _Job, graph: ViewGraph, networks: _Networks) -> tuple[_Estimate, dict[str, float]]:
    """Every link of the method; with the seconds of its stages."""
    watch = _Stopwatch()
    with workers():
        graph, start = graph.to(networks.device), job.warm_start
        component = job.component.to(networks.device)
        for name in job.names[:-1]:
            start = _solve_once(graph, component, name, job.profile, None, start, networks, watch).body_from_world
        last, steps = job.names[-1], job.last_steps
        if job.memory is not None and start is not None and job.may_update:
            estimate = _update_slam(graph, job.memory, start, networks, watch)
            if estimate is not None:
                return estimate, watch.seconds
        return _solve_once(graph, component, last, job.profile, steps, start, networks, watch), watch.seconds


def _update_slam(
    graph: ViewGraph, memory: SlamMemory, warm_start: Tensor, networks: _Networks, watch: _Stopwatch
) -> _Estimate | None:
    """The SLAM profile's solve of a graph that has grown by a few edges; None if the whole of it is due."""
    with watch.stage("update"):
        updated = memory.updated(graph, networks.load("slam-clean-net"), warm_start.double())
        return None if updated is None else _slam_estimate(*updated)


def _solve_once(
    graph: ViewGraph,
    component: Tensor,
    name: str,
    profile: str,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: _Networks,
    watch: _Stopwatch,
) -> _Estimate:
    """One method, or one link of a combination."""
    if graph.num_edges == 0:
        unknown = torch.full((graph.num_nodes,), torch.nan)
        return _Estimate(rotations.identity(graph.num_nodes), torch.empty(0).double(), unknown)
    if name in BASELINES:
        return _solve_baseline(graph, name, profile, warm_start, watch)
    if profile == "slam":
        return _solve_slam(graph, NETWORK_METHODS[name], refinement_steps, warm_start, networks, watch)
    return _solve_sfm(graph, component, NETWORK_METHODS[name], refinement_steps, warm_start, networks, watch)


def _solve_baseline(
    graph: ViewGraph, name: str, profile: str, warm_start: Tensor | None, watch: _Stopwatch
) -> _Estimate:
    """One of the methods to compare with. It gives no scores, so the residuals it leaves must do."""
    baseline = importlib.import_module("rotavg_ros.baselines").BASELINES[name]
    if profile == "sfm":  # where an order of the nodes means nothing
        graph = replace(graph, kind=torch.full_like(graph.kind, EdgeKind.LOOP_CLOSURE))
    with watch.stage(name):
        orientations = baseline(graph, warm_start)
    score = sfm_stages.residual_score(graph, orientations, _OUTLIER_ANGLE[profile])
    return _Estimate(orientations, score, torch.full((graph.num_nodes,), torch.nan))


def _solve_sfm(
    graph: ViewGraph,
    component: Tensor,
    method: Method,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: _Networks,
    watch: _Stopwatch,
) -> _Estimate:
    if graph.num_edges > _TUNING_PAYS and graph.device.type == "cpu":
        tune()
    with watch.stage("clean"):
        if method.clean:
            cleaned = sfm_stages.clean(networks.load("sfm-clean-net"), graph)
        else:
            cleaned = sfm_stages.trust_all(graph)
        cleaned = sfm_stages.apply_labels(cleaned, graph.label)
    with watch.stage("bootstrap"):
        orientations, roots, cleaned = sfm_stages.bootstrap(cleaned, component)
        if warm_start is not None:
            orientations = warm_start.double().to(graph.device)
    for _ in range(method.fine_tunings):
        with watch.stage("fine-tune"):
            orientations = sfm_stages.fine_tune(networks.load("sfm-fine-net"), cleaned, orientations, component)
    default_steps = sfm_refinement.MAX_STEPS if method.shaped else refinement.DEFAULT_STEPS
    steps = (default_steps if method.refine else 0) if refinement_steps is None else refinement_steps
    if steps > 0:
        with watch.stage("refine"):
            allowed = (graph.label != EdgeLabel.REJECTED).double()
            weight = 1 - cleaned.outlier_probability if method.weighted else allowed
            if method.shaped:
                orientations = sfm_refinement.refine(
                    graph,
                    orientations,
                    roots,
                    steps,
                    prior_weight=allowed,
                    coarse_weight=weight,
                    component=component,
                    edges=cleaned.edges,
                )
            else:
                orientations = refinement.refine(
                    graph, orientations, weight, roots, steps, component=component, edges=cleaned.edges
                )
    fits = steps > 0 or method.fine_tunings > 0
    score = sfm_stages.outlier_score(graph, cleaned, orientations, component, by_residuals=fits)
    return _Estimate(orientations, score, torch.full((graph.num_nodes,), torch.nan))


def _solve_slam(
    graph: ViewGraph,
    method: Method,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: _Networks,
    watch: _Stopwatch,
) -> _Estimate:
    with watch.stage("contract"):
        prepared = slam_stages.prepare(graph, scale_estimation=method.scale_estimation)
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
            is_default = method is NETWORK_METHODS[DEFAULT_METHOD]
            memory = SlamMemory.of(graph, prepared, cleaned, estimate) if is_default else None
            return _slam_estimate(prepared.closure_graph, estimate, memory)
    with watch.stage("expand"):
        score = slam_stages.outlier_scores(prepared.closure_graph, 1 - cleaned.inlier_probability)
        orientations = prepared.closure_graph.orientations(correction)
    return _Estimate(orientations, torch.from_numpy(score), torch.full((graph.num_nodes,), torch.nan))


def _slam_estimate(graph: ClosureGraph, estimate: SlamEstimate, memory: SlamMemory | None) -> _Estimate:
    """From the closure graph's nodes and edges to the view-graph's."""
    return _Estimate(
        graph.orientations(estimate.correction),
        torch.from_numpy(slam_stages.outlier_scores(graph, estimate.outlier_probability)),
        torch.from_numpy(graph.variance(estimate.samples, estimate.stated_step_variance)),
        memory,
    )


def _root_at_identity(body_from_world: Tensor, component: Tensor) -> Tensor:
    """The same orientations in the gauge where the first node of every component is the identity."""
    if len(component) == 0:
        return body_from_world
    first = torch.full((int(component.max()) + 1,), len(component))
    first = first.scatter_reduce(0, component, torch.arange(len(component)), "amin")
    gauge = rotations.inverse(body_from_world[first])[component]
    return rotations.normalize(rotations.multiply(body_from_world, gauge))


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UserError(f"unknown {name} {value!r}; choose from {', '.join(choices)}")
