"""The SLAM profile: contract the odometry, clean, bootstrap, refine, expand; or go on from the last solve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.estimate import Estimate, Places, Run
from rotavg_ros.solver.slam import refinement as slam_refinement
from rotavg_ros.solver.slam import stages as slam_stages
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import all_fine_tuned
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph, contract_along
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.passes.alternation import Verdicts
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.poses.solve import (
    has_places,
    likeliest_poses,
    mode_of_passes,
    poses_of,
    poses_of_update,
)
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.modes import publish
from rotavg_ros.solver.slam.posterior.solve import search
from rotavg_ros.solver.slam.preparation import Prepared, prepare, prepared_with
from rotavg_ros.solver.slam.update.grown_edges import begins_with, carried_over
from rotavg_ros.solver.slam.update.memory import SlamMemory, Updated, WholeSolveMemory
from rotavg_ros.solver.slam.update.posterior_memory import PosteriorMemory, estimate_of
from rotavg_ros.view_graph import ViewGraph

# A graph of more key nodes is updated by rotations alone.
_MAX_JOINT_UPDATE = 2000


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
    watch = run.watch
    steps = run.refinement_steps
    if steps is None:
        steps = slam_refinement.MAX_PASSES if stages.refine else 0
    if steps > 0 and stages.posterior:
        return _solve_by_posterior(graph, stages, run)
    with watch.stage("contract"):
        prepared = prepare(graph, scale_estimation=stages.scale_estimation)
    with watch.stage("clean"):
        has_network = stages.clean and "cleannet" not in stages.without
        network = run.networks.load(SlamCleanNet) if has_network else None
        cleaned = slam_stages.clean(network, prepared, graph.label)
    with watch.stage("bootstrap"):
        if run.warm_start is not None:
            correction = prepared.closure_graph.corrections(run.warm_start.double())
        elif stages.tree_start:
            correction = slam_stages.bootstrap(prepared, cleaned)
        else:
            correction = rotations.identity(prepared.closure_graph.num_nodes)
    if steps > 0:
        with watch.stage("refine"):
            estimate = slam_stages.refine_and_search(prepared, cleaned, correction, steps, stages=stages)
        with watch.stage("expand"):
            closure_graph = prepared.closure_graph
            variance = closure_graph.variance(estimate.samples, estimate.stated_step_variance)
            is_default = stages == SlamStages()
            memory = SlamMemory.of(graph, prepared, cleaned, estimate, variance) if is_default else None
        rotations_alone = _slam_estimate(closure_graph, estimate, variance, memory)
        if not is_default or not has_places(graph):
            return rotations_alone
        with watch.stage("poses"):
            mode = mode_of_passes(prepared, cleaned.network_log_odds, estimate)
            found = poses_of(graph, mode, _poses_before(graph, run))
            return _with_poses(graph, rotations_alone, found)
    with watch.stage("expand"):
        score = slam_stages.outlier_scores(prepared.closure_graph, 1 - cleaned.inlier_probability)
        orientations = prepared.closure_graph.orientations(correction)
    return Estimate(orientations, torch.from_numpy(score), torch.full((graph.num_nodes,), torch.nan))


def _poses_before(graph: ViewGraph, run: Run) -> PoseMemory | None:
    """Where those of the passes begin, if the graph has grown from one that was solved so."""
    before = run.memory
    if isinstance(before, (SlamMemory, WholeSolveMemory)) and begins_with(graph, before.graph):
        return before.poses
    return None


def _solve_by_posterior(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """The same by one posterior, which draws the graph together and cleans it as often as odometry may be biased."""

    def begin(prepared: Prepared, cleaned: slam_stages.CleanedClosures) -> Tensor:
        if run.warm_start is not None:
            return prepared.closure_graph.corrections(run.warm_start.double())
        if "tree" in stages.without:
            return rotations.identity(prepared.closure_graph.num_nodes)
        return slam_stages.bootstrap(prepared, cleaned)

    network = None if "cleannet" in stages.without else run.networks.load(SlamCleanNet)
    with run.watch.stage("refine"):
        found = search(graph, network, begin, stages.without)
        modes = found.modes
        if "fine-net" not in stages.without:
            modes = all_fine_tuned(modes, run.networks.load(SlamFineNet))
        published = publish(found.drawn.problem, modes)
    with run.watch.stage("expand"):
        estimate, likeliest, poses = estimate_of(published, modes[0].state.noise), modes[0], None
    if "translations" not in stages.without and has_places(graph):
        with run.watch.stage("poses"):
            poses, likeliest = likeliest_poses(_unbiased(graph, found.bias), modes)
    if not stages.without:
        # Updates go on from a labelling as the search left it.
        mode = next(before for before, after in zip(found.modes, modes, strict=True) if after is likeliest)
        estimate = replace(estimate, memory=PosteriorMemory.of(graph, found.bias, mode, estimate))
    return estimate if poses is None else _with_poses(graph, estimate, poses)


def _unbiased(graph: ViewGraph, bias: np.ndarray | None) -> ViewGraph:
    """The graph without a gyroscope's bias, rad per step, if one was taken out of its odometry."""
    return graph if bias is None else without_bias(graph, bias)


def _with_poses(graph: ViewGraph, estimate: Estimate, memory: PoseMemory) -> Estimate:
    """The estimate of rotations alone, with orientations, positions and closures' scores by translations as well.

    Whether odometry slipped is told by rotations.
    """
    poses = memory.poses
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
        memory=_remembering(graph, estimate.memory, memory),
        step_variance=_step_variance(graph, poses.precision),
        # The posterior's is of answers that rotations alone do not tell apart.
        warnings=estimate.warnings if len(poses.rivals) > 1 else (),
    )


def _step_variance(graph: ViewGraph, precision: np.ndarray) -> float:
    """rad², of one step of sound odometry, from the precisions ``(M, 2)`` with which edges count."""
    odometry = graph.is_odometry.numpy()
    return float(np.median(1 / (precision[odometry, 0] * graph.steps.numpy()[odometry])))


def _remembering(graph: ViewGraph, memory: object | None, poses: PoseMemory) -> object:
    """The memory of rotations, if there is one, with that of poses."""
    if isinstance(memory, (SlamMemory, PosteriorMemory)):
        return replace(memory, poses=poses)
    return WholeSolveMemory(graph, poses)


def _slam_estimate(
    graph: ClosureGraph, verdicts: Verdicts, variance: np.ndarray, memory: SlamMemory | None
) -> Estimate:
    """From the closure graph's nodes and edges to the view-graph's, of whose nodes ``variance`` ``(N,)`` is."""
    return Estimate(
        graph.orientations(verdicts.correction),
        torch.from_numpy(slam_stages.outlier_scores(graph, verdicts.outlier_probability)),
        torch.from_numpy(variance),
        memory,
        step_variance=max(verdicts.noise.step_variance, verdicts.noise.likely_step_variance),
    )


def update_slam(graph: ViewGraph, memory: SlamMemory | PosteriorMemory, run: Run) -> Estimate | None:
    """The solve of a graph that has grown by a few edges since ``memory``; None if the whole of it is due.

    ``run`` has the warm start.
    """
    assert run.warm_start is not None
    before = memory.poses
    start = run.warm_start.double() if before is None else before.start_alone(graph)
    if start is None or (before is None) is has_places(graph):
        return None
    if isinstance(memory, PosteriorMemory):
        return _updated_by_search(graph, memory, start, run)
    return _updated_by_passes(graph, memory, start, run)


def _updated_by_search(graph: ViewGraph, memory: PosteriorMemory, start: Tensor, run: Run) -> Estimate | None:
    with run.watch.stage("update"):
        networks = run.networks.load(SlamCleanNet), run.networks.load(SlamFineNet)
        found = memory.updated(graph, networks, start)
    before = memory.poses
    if found is None or before is None:
        return None if found is None else found.estimate
    with run.watch.stage("poses"):
        unbiased = _unbiased(graph, memory.bias)
        poses = before.extended(unbiased) if found.mode is None else poses_of_update(unbiased, found.mode, before)
        return None if poses is None else _with_poses(graph, found.estimate, poses)


def _updated_by_passes(graph: ViewGraph, memory: SlamMemory, start: Tensor, run: Run) -> Estimate | None:
    with run.watch.stage("update"):
        updated = memory.updated(graph, run.networks.load(SlamCleanNet), start)
        if updated is None:
            return None
        estimate = _slam_estimate(*updated)
    before = memory.poses
    if before is None:
        return estimate
    with run.watch.stage("poses"):
        if (extended := before.extended(graph)) is not None:
            return _with_poses(graph, estimate, extended)
        if updated.closure_graph.num_nodes > _MAX_JOINT_UPDATE:
            return _with_places_of_before(estimate, before)
        poses = poses_of_update(graph, _mode_of(graph, updated), before)
        return None if poses is None else _with_poses(graph, estimate, poses)


def _mode_of(graph: ViewGraph, updated: Updated) -> Mode:
    """Labels and noise of an update by the passes, as the posterior sees them."""
    memory = updated.memory
    prepared = prepared_with(contract_along(graph, memory.paths), memory.paths.forest, memory.chain_noise)
    told = carried_over(memory.network_log_odds, prepared.closure_graph, 0.0)
    return mode_of_passes(prepared, told, updated.verdicts)


def _with_places_of_before(estimate: Estimate, before: PoseMemory) -> Estimate:
    """With what was known of closures' places; new ones are judged by their rotations until the next whole solve."""
    wrong = torch.zeros(len(estimate.outlier_score), dtype=torch.float64)
    wrong[: before.num_edges] = torch.from_numpy(before.wrong_place)
    score = 1 - (1 - estimate.outlier_score) * (1 - wrong)
    return replace(estimate, outlier_score=score)
