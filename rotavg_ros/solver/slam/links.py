"""Solves a graph in which most closures span few keyframes: a search without these, then a solve with them.

A search tries labellings, and each costs a solve of all closures. Those over few keyframes hardly change which loop
closures are likely: odometry spans as little about as well. So the search is made without them, and its labels are
where the solve with all of them begins. Where they contradict that, the search is made with all of them after all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from rotavg_ros.solver.estimate import Estimate, Run
from rotavg_ros.solver.running.kept_labels import KeptLabels
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.restated_odometry import LOOP_STEPS
from rotavg_ros.solver.slam.poses.solve import poses_of_kept
from rotavg_ros.solver.slam.preparation import contract_odometry
from rotavg_ros.solver.slam.update.memory import SlamMemory, with_poses
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Links are set aside if there are as many as other closures, and at least so many of either.
_LEAST_LINKS, _LEAST_OTHERS = 100, 10
# Largest share of closures that may contradict the labels of the search.
_CONTRADICTING = 0.02
_GOOD = 0.5


def links_of(graph: ViewGraph) -> np.ndarray | None:
    """``(n,)`` measured closures over few keyframes; None unless they are most of all closures."""
    if int((~graph.is_odometry).sum()) < _LEAST_LINKS + _LEAST_OTHERS:
        return None
    drawn, _ = contract_odometry(graph)
    outside = drawn.view_graph_edge
    is_closure = drawn.is_closure[drawn.num_segments :]
    is_link = is_closure & (drawn.path_steps[drawn.num_segments :] <= LOOP_STEPS)
    is_link &= graph.label.numpy()[outside] == EdgeLabel.AUTOMATIC
    links, others = int(is_link.sum()), int((is_closure & ~is_link).sum())
    return outside[is_link] if links >= max(_LEAST_LINKS, others) and others >= _LEAST_OTHERS else None


def solved_in_two_parts(
    graph: ViewGraph, links: np.ndarray, whole: Callable[[ViewGraph], Estimate], run: Run
) -> Estimate | None:
    """The answer of a search without links ``(n,)``, and a solve with them; None if they contradict it.

    Also if odometry slipped or jumped, which links place best, or other labellings are nearly as likely.

    Args:
        graph: N nodes, M edges.
        links: those of :func:`links_of`.
        whole: solves a graph by the whole search.
        run: arguments of the solve.
    """
    others = np.setdiff1d(np.arange(graph.num_edges), links)
    first = whole(graph.select_edges(torch.from_numpy(others)))
    memory = first.memory
    if not isinstance(memory, SlamMemory) or memory.is_divided or len(memory.mode.slipped):
        return None
    found = memory.labels
    if found is None:
        return None
    labels = KeptLabels.of_arrays(graph, found.of_edges(others, graph.num_edges))
    labels = replace(labels, search=np.array([int((~graph.is_odometry).sum()), 0.0, 0.0]))
    networks = run.networks.load(SlamCleanNet), run.networks.load(SlamFineNet)
    with run.watch.stage("links"):
        solved = SlamMemory.of_labels(labels, graph, networks, first.body_from_world, np.zeros(0, dtype=np.int64))
        estimate, after = solved.estimate, solved.estimate.memory
        assert isinstance(after, SlamMemory)
        if labels.by_places:
            estimate = with_poses(graph, estimate, poses_of_kept(after.calibrated(graph), solved.mode, labels))
            after = estimate.memory
            assert isinstance(after, SlamMemory)
    changed = (after.trusted[others] > _GOOD) != (memory.trusted > _GOOD)
    rejected = after.trusted[links] <= _GOOD
    if len(solved.mode.slipped) or max(changed.mean(), rejected.mean()) > _CONTRADICTING:
        return None
    return replace(estimate, warnings=first.warnings)
