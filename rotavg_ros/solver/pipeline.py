"""The solve: checks the options, chooses a profile and a device, and runs the links of a combined method in turn."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rotavg_ros import baselines, rotations
from rotavg_ros.errors import UserError
from rotavg_ros.solver import devices, warnings
from rotavg_ros.solver.estimate import Estimate, Run, Stopwatch
from rotavg_ros.solver.methods import DEFAULT_METHOD, check_choices, method_named
from rotavg_ros.solver.neurora.network_store import Networks, check_folder
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.running.kept_labels import KeptLabels
from rotavg_ros.solver.running.threads import for_each, workers
from rotavg_ros.solver.running.work import metered
from rotavg_ros.solver.slam.live import advance as advance_slam
from rotavg_ros.solver.slam.live import resume_slam, update_slam
from rotavg_ros.solver.slam.noise import exceedance
from rotavg_ros.solver.slam.solve import solve_slam
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE, EdgeKind, EdgeLabel, HoldsViewGraph, ViewGraph, view_graph_of

# The noise that makes an edge an outlier, in radians.
OUTLIER_ANGLE = {"sfm": NUMBERS.outlier_angle, "slam": exceedance.OUTLIER_ANGLE}
# With fewer edges, two passes over them take less time than waking another worker.
_WORTH_WORKERS = 50_000


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
    memory: object | None = None,
    work: float | None = None,
    anew: bool = False,
    weights: Path | None = None,
) -> Solution:
    """Absolute orientations and outlier scores of a view-graph.

    Every connected component has a frame of its own. The components of a photo collection are solved independently.
    The robots of one graph are assumed to share their noise, mounting and share of false closures, so data from one
    inform the estimates for the others.

    Args:
        graph: N nodes, M edges; or an object with such a graph as its ``graph``, such as the result of ``read_graph``.
        method: one of :data:`~rotavg_ros.solver.methods.METHODS`, or several joined by "+", each of which starts from
            the answer of the one before. "neurora~A,B" is the default on robots' graphs without A and B
            (:data:`rotavg_ros.solver.slam.options.SWITCHES`); "neurora-paper~A,B" is the paper's method with A and B
            replaced by this package's versions (:data:`rotavg_ros.solver.sfm.options.PAPER_PARTS`).
        profile: "slam" for odometry chains with loop closures, "sfm" for unordered view-graphs, "auto": "slam" if any
            edge is odometry.
        device: where the whole SfM profile runs: "cpu", "cuda", or "auto" (a GPU if torch finds one). If there is no
            working GPU, or it has too little memory, the solve falls back to the CPU and logs it. The SLAM profile and
            the baselines are small and sparse; they run on the CPU.
        refinement_steps: maximum number of refinement steps, 0 for none; default: the method's own number. The SLAM
            profile runs either none (0) or all.
        warm_start: ``(N, 4)`` body_from_world of an earlier solution to start from.
        memory: the memory of the earlier solution by the same method, if the graph has only grown since, or its
            ``labels``, the part that can be written to a file. With it, a warm start of a SLAM graph judges the new
            edges and keeps all other verdicts. If these leave many closures unexplained, everything is judged anew
            alongside.
        work: units (:attr:`~rotavg_ros.solver.solution.Solution.work`) that such a solve may spend. If it needs more,
            the answer is the earlier one extended by the new edges, and :func:`advance` does the rest. The count is
            the same on every machine. Default: no limit.
        anew: such a solve is to arrive at the answer of a solve without a memory;
            :attr:`~rotavg_ros.solver.solution.Solution.is_anew` says when it has.
        weights: folder of networks trained with ``rotavg train``; networks missing there come from the package.

    Returns:
        :class:`~rotavg_ros.solver.solution.Solution`: ``body_from_world`` ``(N, 4)`` xyzw, the inverse of what ROS
        publishes (``world_from_body`` is that); ``outlier_score`` ``(M,)``, the probability that an edge is wrong;
        ``component`` and ``uncertainty`` ``(N,)``; and what was run.

    Raises:
        UserError: ``graph`` is no view-graph, an option is outside its choices, or the warm start has the wrong shape
            or does not consist of rotations.
    """
    graph = view_graph_of(graph).to("cpu")
    check_choices(method, profile, device)
    if weights is not None:
        check_folder(weights)
    _check_numbers(refinement_steps, work)
    _check_start(warm_start, graph.num_nodes)
    names = method.split("+")
    if profile == "auto":
        profile = "slam" if bool(graph.is_odometry.any()) else "sfm"
    is_ours = all(method_named(name) is not None for name in names)
    where = devices.choose(device) if profile == "sfm" and is_ours else "cpu"
    stating_nothing = _first_look(graph)
    job = _Job(graph, graph.components(), names, profile)
    goes_on_from = _memory_of(names, memory) if refinement_steps is None and warm_start is not None else None
    run = Run(Networks(where, weights), Stopwatch(), refinement_steps, warm_start, goes_on_from, work, anew)
    with metered() as meter:
        estimate, run = _run_where_it_can(job, run)
    places = estimate.places
    score = _as_labelled(graph, estimate.outlier_score.cpu())
    rotation_score = None if places is None else _as_labelled(graph, places.rotation_score)
    orientations = _root_at_identity(estimate.body_from_world.cpu(), job.component)
    return Solution(
        orientations,
        score,
        job.component,
        estimate.variance.cpu().double().sqrt().masked_fill(_is_alone(job.component), 0.0),
        run.watch.seconds,
        method,
        profile,
        run.networks.device,
        estimate.memory,
        (
            *estimate.warnings,
            *stating_nothing,
            *warnings.mostly_flagged(graph, score, rotation_score, estimate.restated),
            *(warnings.accepted_far_off(graph, orientations, OUTLIER_ANGLE["sfm"]) if profile == "sfm" else ()),
        ),
        None if places is None else _root_at_origin(places.position, estimate.body_from_world, job.component),
        None if places is None else places.variance.sqrt(),
        rotation_score,
        None if places is None else places.precision,
        math.sqrt(estimate.step_variance),
        meter.spent,
        estimate.is_anew,
    )


def advance(memory: object | None, work: float) -> float:
    """Continue the work that a solve with a limit left undone; the next solve with this memory finds it done.

    Args:
        memory: the memory of that solve's solution.
        work: units to spend; up to one factorisation more may be spent.

    Returns:
        the units spent.
    """
    with metered() as meter:
        if isinstance(memory, SlamMemory):
            advance_slam(memory, work)
    return meter.spent


@dataclass(frozen=True)
class _Job:
    """A graph with the ``component`` ``(N,)`` of every node, the links of a method, a profile."""

    graph: ViewGraph
    component: Tensor
    names: list[str]
    profile: str


def _check_numbers(refinement_steps: int | None, work: float | None) -> None:
    """Raises :class:`UserError` for negative numbers."""
    if refinement_steps is not None and refinement_steps < 0:
        raise UserError(f"refinement steps must not be negative, got {refinement_steps}")
    if work is not None and not work >= 0:
        raise UserError(f"work must be a number of units, 0 or more, got {work}")


def _check_start(warm_start: Tensor | None, num_nodes: int) -> None:
    """Raises :class:`UserError` unless the start has one rotation per node."""
    if warm_start is None:
        return
    if tuple(warm_start.shape) != (num_nodes, 4):
        raise UserError(f"the warm start has shape {tuple(warm_start.shape)}, the graph needs ({num_nodes}, 4)")
    length = warm_start.double().norm(dim=1)
    not_unit = ~((length - 1).abs() <= UNIT_NORM_TOLERANCE)
    if bool(not_unit.any()):
        row = int(not_unit.nonzero()[0])
        raise UserError(f"the warm start's row {row} has length {length[row]:.6g}; give unit quaternions")


def _first_look(graph: ViewGraph) -> tuple[str, ...]:
    """Warnings about edges that state nothing; in parallel, the graph finds its components, which it caches."""
    found: list[tuple[str, ...]] = []

    def look(number: int) -> None:
        if number == 0:
            graph.components()
        else:
            found.append(warnings.stating_nothing(graph))

    for_each(look, (0, 1), None if graph.num_edges > _WORTH_WORKERS else 1)
    return found[0]


def _run_where_it_can(job: _Job, run: Run) -> tuple[Estimate, Run]:
    """Runs the job, on the CPU if the GPU fails; also returns the run that was used in the end."""
    try:
        return _run(job, run), run
    except devices.GPU_ERRORS as error:
        if run.networks.device == "cpu":
            raise
        devices.fall_back(error)
        run = replace(run, networks=replace(run.networks, device="cpu"), watch=Stopwatch())
        return _run(job, run), run


def _memory_of(names: list[str], memory: object | None) -> SlamMemory | KeptLabels | None:
    """The memory, if the method of these names can continue from it."""
    return memory if names == [DEFAULT_METHOD] and isinstance(memory, SlamMemory | KeptLabels) else None


def _run(job: _Job, run: Run) -> Estimate:
    """Runs every link of the method; the last may continue from the memory of an earlier solve of the graph."""
    device = run.networks.device
    job = replace(job, graph=job.graph.to(device), component=job.component.to(device))
    for name in job.names[:-1]:
        before = _solve_once(job, name, replace(run, refinement_steps=None))
        run = replace(run, warm_start=before.body_from_world)
    memory, estimate = run.memory, None
    if run.warm_start is not None and job.profile == "slam":
        if isinstance(memory, SlamMemory):
            estimate = update_slam(job.graph, memory, run)
        elif isinstance(memory, KeptLabels):
            estimate = resume_slam(job.graph, memory, run)
            if estimate is None:  # then a search should not begin at this start either
                run = replace(run, warm_start=None)
    if estimate is not None:
        return _with_warnings(job.graph, estimate)
    if run.anew:  # there is nothing to continue from, and the search must not begin at the warm start
        run = replace(run, warm_start=None)
    estimate = _solve_once(job, job.names[-1], run)
    return _with_warnings(job.graph, estimate) if job.profile == "slam" else estimate


def _with_warnings(graph: ViewGraph, estimate: Estimate) -> Estimate:
    """Adds the warnings about a whole solve of a robot's graph, which hold until the next whole solve."""
    goes_on = estimate.memory
    if isinstance(goes_on, SlamMemory) and goes_on.warnings is not None:
        return replace(estimate, warnings=goes_on.warnings)
    found = warnings.of_whole_solve(graph, estimate.body_from_world, estimate.outlier_score)
    found = (*estimate.warnings, *found)
    if isinstance(goes_on, SlamMemory):
        goes_on = replace(goes_on, warnings=found)
    return replace(estimate, warnings=found, memory=goes_on)


def _solve_once(job: _Job, name: str, run: Run) -> Estimate:
    """One method, or one link of a combination."""
    graph = job.graph
    if graph.num_edges == 0:
        unknown = torch.full((graph.num_nodes,), torch.nan)
        return Estimate(rotations.identity(graph.num_nodes), torch.empty(0).double(), unknown)
    method = method_named(name)
    if method is None:
        return _solve_baseline(job, name, run)
    if job.profile == "slam":
        return solve_slam(graph, method.slam, run)
    from rotavg_ros.solver.sfm.solve import solve_sfm  # not needed for a robot's graph

    return solve_sfm(graph, job.component, method.sfm, run)


def _solve_baseline(job: _Job, name: str, run: Run) -> Estimate:
    """One of the methods to compare with. It gives no scores, so scores are computed from its residuals."""
    graph = job.graph
    if job.profile == "sfm":  # the order of the nodes means nothing there
        graph = replace(graph, kind=torch.full_like(graph.kind, EdgeKind.LOOP_CLOSURE))
    with run.watch.stage(name):
        orientations = baselines.BASELINES[name](graph, run.warm_start)
    score = baselines.residual_score(graph, orientations, OUTLIER_ANGLE[job.profile])
    return Estimate(orientations, score, torch.full((graph.num_nodes,), torch.nan))


def _as_labelled(graph: ViewGraph, score: Tensor) -> Tensor:
    """Scores ``(M,)``; 0 for edges that a user has accepted, 1 for rejected ones."""
    score = torch.where(graph.label == EdgeLabel.ACCEPTED, 0.0, score)
    return torch.where(graph.label == EdgeLabel.REJECTED, 1.0, score)


def _root_at_origin(position: Tensor, body_from_world: Tensor, component: Tensor) -> Tensor:
    """Positions ``(N, 3)`` in the frame of each component's first node."""
    first = _first_nodes(component)
    return rotations.rotate(body_from_world[first][component], position - position[first][component])


def _is_alone(component: Tensor) -> Tensor:
    """``(N,)`` bool, nodes without edges. Such a node is what its orientation is stated relative to."""
    return (torch.bincount(component) == 1)[component]


def _first_nodes(component: Tensor) -> Tensor:
    """``(C,)`` first node of every component."""
    first = torch.full((int(component.max()) + 1,), len(component))
    return first.scatter_reduce(0, component, torch.arange(len(component)), "amin")


def _root_at_identity(body_from_world: Tensor, component: Tensor) -> Tensor:
    """The same orientations in the gauge where the first node of every component is the identity."""
    if len(component) == 0:
        return body_from_world
    gauge = rotations.inverse(body_from_world[_first_nodes(component)])[component]
    return rotations.normalize(rotations.multiply(body_from_world, gauge))
