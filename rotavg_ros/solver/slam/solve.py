"""The SLAM profile: the posterior of a robot's graph, or its tree alone; or go on from the last solve."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.running import Steps, done, metered
from rotavg_ros.solver.estimate import Estimate, Places, Run, Stopwatch
from rotavg_ros.solver.slam import stages as slam_stages
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import all_fine_tuned, fine_tuned
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.poses.solve import has_places, median_poses, poses_of_update
from rotavg_ros.solver.slam.posterior.modes import of_slips, publish
from rotavg_ros.solver.slam.posterior.solve import searching
from rotavg_ros.solver.slam.preparation import Prepared, prepare
from rotavg_ros.solver.slam.update.ahead import WholeSolve
from rotavg_ros.solver.slam.update.memory import SlamMemory, estimate_of
from rotavg_ros.view_graph import ViewGraph


def solve_slam(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """One method on a graph that lives on the CPU; what it states more than once counts once."""
    repeats = first_of_each(graph)
    if repeats is None:
        return _solve_once(graph, stages, run)
    first, says_as = (torch.from_numpy(edges) for edges in repeats)
    estimate = _solve_once(graph.select_edges(first), stages, run)
    places = estimate.places
    if places is not None:
        places = replace(places, rotation_score=places.rotation_score[says_as], precision=places.precision[says_as])
    return replace(estimate, outlier_score=estimate.outlier_score[says_as], memory=None, places=places)


def _solve_once(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """The same for a graph without repetitions."""
    refines = stages.refine if run.refinement_steps is None else run.refinement_steps > 0
    return done(whole(graph, stages, run)) if refines else _solve_by_tree(graph, stages, run)


def _solve_by_tree(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """Odometry drawn together, closures judged, orientations along the tree of least expected error."""
    watch = run.watch
    with watch.stage("contract"):
        prepared = prepare(graph)
    with watch.stage("clean"):
        cleaned = slam_stages.clean(_clean_net(stages, run), prepared, graph.label)
    with watch.stage("bootstrap"):
        correction = _begin(stages, run, prepared, cleaned)
    with watch.stage("expand"):
        score = slam_stages.outlier_scores(prepared.closure_graph, 1 - cleaned.inlier_probability)
        orientations = prepared.closure_graph.orientations(correction)
    return Estimate(orientations, torch.from_numpy(score), torch.full((graph.num_nodes,), torch.nan))


def whole(graph: ViewGraph, stages: SlamStages, run: Run) -> Steps[Estimate]:
    """By one posterior: the search from all starts, FineNet, what is published of the labellings, and their poses.

    The graph is drawn together and cleaned as often as odometry may be biased. Left after each start and move.
    """
    with run.watch.stage("refine"):
        found = yield from searching(graph, _clean_net(stages, run), partial(_begin, stages, run), stages.without)
        fine_net = None if "fine-net" in stages.without else run.networks.load(SlamFineNet)
        tuned = found.modes if fine_net is None else all_fine_tuned(found.modes, fine_net)
        published = publish(found.drawn.problem, tuned)
    with run.watch.stage("expand"):
        estimate, mode, poses = estimate_of(published, tuned[0].state.noise), found.modes[published.chosen], None
    yield
    if "translations" not in stages.without and has_places(graph):
        with run.watch.stage("poses"):
            tune = (lambda mode: mode) if fine_net is None else partial(fine_tuned, network=fine_net)
            poses, mode = yield from median_poses(_unbiased(graph, found.bias), found.modes, tune)
    if stages == SlamStages():
        is_divided = bool(published.warnings) if poses is None else poses.poses.is_divided
        estimate = replace(estimate, memory=SlamMemory.of(graph, found.bias, mode, estimate, is_divided))
    estimate = estimate if poses is None else _with_poses(graph, estimate, poses)
    return replace(estimate, warnings=(*estimate.warnings, *of_slips(mode)))


def _clean_net(stages: SlamStages, run: Run) -> SlamCleanNet | None:
    return run.networks.load(SlamCleanNet) if stages.clean and "cleannet" not in stages.without else None


def _begin(stages: SlamStages, run: Run, prepared: Prepared, cleaned: slam_stages.CleanedClosures) -> Tensor:
    """Corrections ``(K, 4)`` to begin with."""
    if run.warm_start is not None:
        return prepared.closure_graph.corrections(run.warm_start.double())
    if "tree" in stages.without:
        return rotations.identity(prepared.closure_graph.num_nodes)
    return slam_stages.bootstrap(prepared, cleaned)


def _unbiased(graph: ViewGraph, bias: np.ndarray | None) -> ViewGraph:
    """The graph without a gyroscope's bias, rad per step, if one was taken out of its odometry."""
    return graph if bias is None else without_bias(graph, bias)


def _with_poses(graph: ViewGraph, estimate: Estimate, memory: PoseMemory) -> Estimate:
    """The estimate of rotations alone, with orientations, positions and closures' scores by translations as well.

    Whether odometry slipped is told by rotations.
    """
    poses, goes_on = memory.poses, estimate.memory
    by_both = (poses.outlier_probability, poses.rotation_probability)
    score, rotation_score = (
        torch.where(graph.is_odometry, estimate.outlier_score, torch.from_numpy(probability)) for probability in by_both
    )
    places = Places(
        torch.from_numpy(poses.position),
        torch.from_numpy(poses.position_variance),
        rotation_score,
        torch.from_numpy(poses.precision),
    )
    return replace(
        estimate,
        body_from_world=torch.from_numpy(np.ascontiguousarray(poses.body_from_world)),
        outlier_score=score,
        variance=torch.from_numpy(poses.variance),
        places=places,
        memory=goes_on.with_poses(memory) if isinstance(goes_on, SlamMemory) else None,
        step_variance=_step_variance(graph, poses.precision),
        # The posterior's is of answers that rotations alone do not tell apart.
        warnings=estimate.warnings if poses.is_divided else (),
    )


def _step_variance(graph: ViewGraph, precision: np.ndarray) -> float:
    """rad², of one step of sound odometry, from the precisions ``(M, 2)`` with which edges count."""
    odometry = graph.is_odometry.numpy()
    return float(np.median(1 / (precision[odometry, 0] * graph.steps.numpy()[odometry])))


def update_slam(graph: ViewGraph, memory: SlamMemory, run: Run) -> Estimate | None:
    """The solve of a graph that has grown by a few edges since ``memory``; None if nothing can be gone on from.

    Where the whole search is due it runs beside updates, as far as ``run`` has work for it each time; once it is
    through, updates go on from what it has found. ``run`` has the warm start.
    """
    with metered() as meter:
        estimate = _updated(graph, memory, run)
    if estimate is None:
        return None
    goes_on = estimate.memory
    assert isinstance(goes_on, SlamMemory)
    ahead = goes_on.ahead
    if ahead is None or ahead.has_failed:
        if not goes_on.is_due:
            return estimate
        ahead = WholeSolve(whole(graph, SlamStages(), replace(run, watch=Stopwatch())))
    with run.watch.stage("search"):
        found = ahead.go_on(math.inf if run.work is None else run.work - meter.spent)
    if found is None:
        return replace(estimate, memory=replace(goes_on, ahead=ahead))
    assert isinstance(found.memory, SlamMemory)
    searched = found.memory.graph
    if (searched.num_nodes, searched.num_edges) != (graph.num_nodes, graph.num_edges):
        found = _updated(graph, found.memory, run) or replace(estimate, memory=replace(goes_on, ahead=None))
    return found


def _updated(graph: ViewGraph, memory: SlamMemory, run: Run) -> Estimate | None:
    """From the labelling before, closures that are new judged by it."""
    assert run.warm_start is not None
    before = memory.poses
    start = run.warm_start.double() if before is None else before.start_alone(graph)
    if start is None or (before is None) is has_places(graph):
        return None
    with run.watch.stage("update"):
        networks = run.networks.load(SlamCleanNet), run.networks.load(SlamFineNet)
        found = memory.updated(graph, networks, start)
    if found is None:
        return None
    estimate = found.estimate
    if before is not None:
        with run.watch.stage("poses"):
            unbiased = _unbiased(graph, memory.bias)
            poses = before.extended(unbiased) if found.mode is None else poses_of_update(unbiased, found.mode, before)
            if poses is None:
                return None
            estimate = _with_poses(graph, estimate, poses)
    assert isinstance(estimate.memory, SlamMemory)
    return replace(estimate, memory=estimate.memory.since(memory, estimate.outlier_score))
