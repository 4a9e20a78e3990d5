"""The SfM profile: clean → bootstrap → fine-tune, as the paper has it (NeuRoRA, §4), and refine."""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.estimate import Estimate, Run
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.neurora.scores import residual_score
from rotavg_ros.solver.neurora.stages import apply_labels, clean, fine_tune, trust_all
from rotavg_ros.solver.neurora.tiled.tuning import tune
from rotavg_ros.solver.neurora.tree import bootstrap
from rotavg_ros.solver.sfm import refinement, round_refinement
from rotavg_ros.solver.sfm.options import SfmStages
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# A graph of more edges is worth measuring what tiles this machine likes.
_TUNING_PAYS = 200_000


def solve_sfm(graph: ViewGraph, component: Tensor, stages: SfmStages, run: Run) -> Estimate:
    """One method on a graph, on the device that the graph is on.

    Args:
        component: ``(N,)`` of every node.
    """
    networks, watch = run.networks, run.watch
    if graph.num_edges > _TUNING_PAYS and graph.device.type == "cpu":
        tune()
    with watch.stage("clean"):
        cleaned = clean(networks.load(CleanNet), graph) if stages.clean else trust_all(graph)
        cleaned = apply_labels(cleaned, graph.label)
    with watch.stage("bootstrap"):
        orientations, roots, cleaned = bootstrap(cleaned, component)
        if run.warm_start is not None:
            orientations = run.warm_start.double().to(graph.device)
    for _ in range(stages.fine_tunings):
        with watch.stage("fine-tune"):
            orientations = fine_tune(networks.load(FineNet), cleaned, orientations, component)
    default_steps = refinement.MAX_STEPS if stages.shaped else round_refinement.DEFAULT_STEPS
    steps = (default_steps if stages.refine else 0) if run.refinement_steps is None else run.refinement_steps
    if steps > 0:
        with watch.stage("refine"):
            allowed = (graph.label != EdgeLabel.REJECTED).double()
            weight = 1 - cleaned.outlier_probability if stages.weighted else allowed
            if stages.shaped:
                orientations = refinement.refine(
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
                orientations = round_refinement.refine(
                    graph, orientations, weight, roots, steps, component=component, edges=cleaned.edges
                )
    fits = steps > 0 or stages.fine_tunings > 0
    # Where there is but a tree, CleanNet's own score; else a residual is the noise but for the orientations' error.
    probability = cleaned.outlier_probability.double()
    score = residual_score(graph, orientations, NUMBERS.outlier_angle, component) if fits else probability
    return Estimate(orientations, score, torch.full((graph.num_nodes,), torch.nan))
