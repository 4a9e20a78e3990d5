"""The solve: options checked, a profile and a device chosen, the links of a combined method run one after the other."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.errors import UserError
from rotavg_ros.solver import devices, sfm_stages, slam_judging, slam_refinement
from rotavg_ros.solver.methods import BASELINES, DEFAULT_METHOD, DEVICES, METHODS, NETWORK_METHODS, PROFILES
from rotavg_ros.solver.parallel import workers
from rotavg_ros.solver.profile import Estimate, Networks, Stopwatch
from rotavg_ros.solver.sfm_profile import solve_sfm
from rotavg_ros.solver.slam_memory import SlamMemory
from rotavg_ros.solver.slam_profile import solve_slam, update_slam
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, HoldsViewGraph, ViewGraph, view_graph_of

# The noise that makes an edge an outlier, in radians.
_OUTLIER_ANGLE = {"sfm": sfm_stages.OUTLIER_ANGLE, "slam": slam_judging.OUTLIER_ANGLE}


@torch.no_grad()
@workers()
def solve(
    graph: ViewGraph | HoldsViewGraph,
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
        graph: N nodes, M edges; or what has it as its ``graph``, as the result of ``read_graph`` does.
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

    Returns:
        :class:`~rotavg_ros.solver.solution.Solution`: ``body_from_world`` ``(N, 4)`` xyzw, the inverse of what ROS
        publishes (``world_from_body`` is that); ``outlier_score`` ``(M,)``, the probability that an edge is wrong;
        ``component`` and ``uncertainty`` ``(N,)``; and what was run.

    Raises:
        UserError: no view-graph, an option outside its choices, or a start of the wrong shape.
    """
    graph = view_graph_of(graph)
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
        estimate, seconds = _run(job, graph, Networks(where, weights))
    except devices.GPU_ERRORS as error:
        if where == "cpu":
            raise
        devices.fall_back(error)
        where = "cpu"
        estimate, seconds = _run(job, graph, Networks(where, weights))
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


def _run(job: _Job, graph: ViewGraph, networks: Networks) -> tuple[Estimate, dict[str, float]]:
    """Every link of the method; with the seconds of its stages."""
    watch = Stopwatch()
    graph, start = graph.to(networks.device), job.warm_start
    component = job.component.to(networks.device)
    for name in job.names[:-1]:
        start = _solve_once(graph, component, name, job.profile, None, start, networks, watch).body_from_world
    last, steps = job.names[-1], job.last_steps
    if job.memory is not None and start is not None and job.may_update:
        estimate = update_slam(graph, job.memory, start, networks, watch)
        if estimate is not None:
            return estimate, watch.seconds
    return _solve_once(graph, component, last, job.profile, steps, start, networks, watch), watch.seconds


def _solve_once(
    graph: ViewGraph,
    component: Tensor,
    name: str,
    profile: str,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: Networks,
    watch: Stopwatch,
) -> Estimate:
    """One method, or one link of a combination."""
    if graph.num_edges == 0:
        unknown = torch.full((graph.num_nodes,), torch.nan)
        return Estimate(rotations.identity(graph.num_nodes), torch.empty(0).double(), unknown)
    if name in BASELINES:
        return _solve_baseline(graph, name, profile, warm_start, watch)
    if profile == "slam":
        return solve_slam(graph, NETWORK_METHODS[name], refinement_steps, warm_start, networks, watch)
    return solve_sfm(graph, component, NETWORK_METHODS[name], refinement_steps, warm_start, networks, watch)


def _solve_baseline(graph: ViewGraph, name: str, profile: str, warm_start: Tensor | None, watch: Stopwatch) -> Estimate:
    """One of the methods to compare with. It gives no scores, so the residuals it leaves must do."""
    baseline = importlib.import_module("rotavg_ros.baselines").BASELINES[name]
    if profile == "sfm":  # where an order of the nodes means nothing
        graph = replace(graph, kind=torch.full_like(graph.kind, EdgeKind.LOOP_CLOSURE))
    with watch.stage(name):
        orientations = baseline(graph, warm_start)
    score = sfm_stages.residual_score(graph, orientations, _OUTLIER_ANGLE[profile])
    return Estimate(orientations, score, torch.full((graph.num_nodes,), torch.nan))


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
