"""The SfM profile: clean → bootstrap → fine-tune, as the paper has it (NeuRoRA, §4), and refine."""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver import refinement, sfm_refinement, sfm_stages, sfm_step
from rotavg_ros.solver.methods import Method
from rotavg_ros.solver.profile import Estimate, Networks, Stopwatch
from rotavg_ros.solver.tuning import tune
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# A graph of more edges is worth measuring what tiles this machine likes.
_TUNING_PAYS = 200_000


def solve_sfm(
    graph: ViewGraph,
    component: Tensor,
    method: Method,
    refinement_steps: int | None,
    warm_start: Tensor | None,
    networks: Networks,
    watch: Stopwatch,
) -> Estimate:
    """One method on a graph, on the device that the graph is on.

    Args:
        component: ``(N,)`` of every node.
        refinement_steps: at most, 0 for none; None: as many as the method likes.
        warm_start: ``(N, 4)`` body_from_world instead of the tree's.
    """
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
    default_steps = sfm_refinement.PRIORS.max_steps if method.shaped else refinement.DEFAULT_STEPS
    steps = (default_steps if method.refine else 0) if refinement_steps is None else refinement_steps
    if steps > 0:
        with watch.stage("refine"):
            allowed = (graph.label != EdgeLabel.REJECTED).double()
            weight = 1 - cleaned.outlier_probability if method.weighted else allowed
            if method.shaped:
                structure = sfm_step.Structure(component, roots, cleaned.edges)
                weights = sfm_refinement.EdgeWeights(allowed, allowed * weight)
                orientations = sfm_refinement.refine(graph, orientations, steps, structure=structure, weights=weights)
            else:
                orientations = refinement.refine(
                    graph, orientations, weight, roots, steps, component=component, edges=cleaned.edges
                )
    fits = steps > 0 or method.fine_tunings > 0
    score = sfm_stages.outlier_score(graph, cleaned, orientations, component, by_residuals=fits)
    return Estimate(orientations, score, torch.full((graph.num_nodes,), torch.nan))
