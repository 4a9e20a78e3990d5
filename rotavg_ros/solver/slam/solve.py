"""The SLAM profile: solves a robot's graph by the posterior, or by the tree alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.estimate import Estimate, Run
from rotavg_ros.solver.running.work import metered
from rotavg_ros.solver.slam import stages as slam_stages
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import fine_tuned
from rotavg_ros.solver.slam.links import with_links
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.calibration import calibrated
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.poses.search.jumps import jump_warnings
from rotavg_ros.solver.slam.poses.solve import Median, has_places, median_poses
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.publishing.modes import publish
from rotavg_ros.solver.slam.posterior.publishing.notes import notes_of
from rotavg_ros.solver.slam.posterior.solve import search
from rotavg_ros.solver.slam.preparation import Prepared, prepare
from rotavg_ros.solver.slam.update.copies import Copies
from rotavg_ros.solver.slam.update.memory import SlamMemory, estimate_of, with_copies, with_poses
from rotavg_ros.view_graph import ViewGraph

# Assumed work of an update, as a share of a whole solve's, until one has been measured.
_UPDATE = 0.1


def solve_slam(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """Solves a graph on the CPU; of several statements of one measurement only the first counts."""
    copies = Copies.of(graph)
    return with_copies(_solve_once(graph if copies is None else copies.once, stages, run), copies)


def _solve_once(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """Solves a graph without repeated edges."""
    refines = stages.refine if run.refinement_steps is None else run.refinement_steps > 0
    return whole(graph, stages, run) if refines else _solve_by_tree(graph, stages, run)


def _solve_by_tree(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """Contracts the odometry, judges the closures, and composes orientations along the tree of least expected error."""
    watch = run.watch
    with watch.stage("contract"):
        prepared = prepare(graph)
    with watch.stage("clean"):
        cleaned = slam_stages.clean(_clean_net(stages, run), prepared, graph.label)
    with watch.stage("bootstrap"):
        correction = _begin(stages, run, prepared, cleaned)
    with watch.stage("expand"):
        score = slam_stages.outlier_scores(prepared.closure_graph, 1 - cleaned.inlier_probability, 0.0)
        orientations = prepared.closure_graph.orientations(correction)
    return Estimate(orientations, torch.from_numpy(score), torch.full((graph.num_nodes,), torch.nan))


def whole(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    """Solves by the posterior: search from all starts, FineNet, the published answer of the labellings, their poses.

    The graph is contracted and cleaned again for each candidate of a systematic error.
    """
    with metered() as meter:
        links = np.zeros(0, dtype=np.int64)
        if "links" not in stages.without:
            graph, links = with_links(graph)
        estimate = _whole(graph, stages, run)
    memory = estimate.memory
    if not isinstance(memory, SlamMemory):
        return estimate
    return replace(estimate, memory=replace(memory, links=links, update_work=_UPDATE * meter.spent))


def _whole(graph: ViewGraph, stages: SlamStages, run: Run) -> Estimate:
    with run.watch.stage("refine"):
        found = search(graph, _clean_net(stages, run), partial(_begin, stages, run), stages.without)
        tune = _tuning(stages, run)
    poses: Median | None = None
    if "translations" not in stages.without and has_places(graph):
        with run.watch.stage("poses"):
            poses = median_poses(calibrated(graph, found.calibration), found.modes, tune)
            if found.otherwise is not None and (found.is_undecided or poses.is_contradicted):
                # Translations may tell of a bias where rotations hardly do, or tell that there is none.
                other = median_poses(calibrated(graph, found.otherwise.calibration), found.otherwise.modes, tune)
                if other.cost + found.otherwise.tilts < poses.cost + found.tilts:
                    found, poses = replace(found.otherwise, suspected=found.suspected), other
    with run.watch.stage("expand"):
        published = publish(found.drawn.problem, found.modes, tune)
        estimate, mode = estimate_of(published), found.modes[published.chosen] if poses is None else poses.mode
    # The posterior's warning is about rivals by rotations alone; translations may have decided between them.
    told = estimate.warnings if poses is None else poses.memory.poses.warnings
    jumps = () if poses is None else jump_warnings(poses.memory.pose)
    estimate = replace(estimate, warnings=(*told, *notes_of(mode, found.suspected), *jumps))
    if stages == SlamStages():
        memory = SlamMemory.of(graph, found.calibration, mode, estimate, bool(told))
        estimate = replace(estimate, memory=memory)
    return estimate if poses is None else with_poses(graph, estimate, poses.memory)


def _clean_net(stages: SlamStages, run: Run) -> SlamCleanNet | None:
    return run.networks.load(SlamCleanNet) if stages.clean and "cleannet" not in stages.without else None


def _tuning(stages: SlamStages, run: Run) -> Callable[[Mode], Mode]:
    """The function that sets each edge's noise in a labelling by FineNet, or leaves the labelling unchanged."""
    if "fine-net" in stages.without:
        return lambda mode: mode
    return partial(fine_tuned, network=run.networks.load(SlamFineNet))


def _begin(stages: SlamStages, run: Run, prepared: Prepared, cleaned: slam_stages.CleanedClosures) -> Tensor:
    """Corrections ``(K, 4)`` to begin with."""
    if run.warm_start is not None:
        return prepared.closure_graph.corrections(run.warm_start.double())
    if "tree" in stages.without:
        return rotations.identity(prepared.closure_graph.num_nodes)
    return slam_stages.bootstrap(prepared, cleaned)
