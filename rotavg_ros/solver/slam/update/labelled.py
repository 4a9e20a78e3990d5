"""A solve from labels: finds the posterior's mode nearest to them, without a search for others."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from torch import Tensor

from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import fine_tuned
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.left_out import relabelled
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.publishing.modes import Published, publish
from rotavg_ros.solver.slam.posterior.solve import Drawn
from rotavg_ros.solver.slam.posterior.state import Noise, Others, State
from rotavg_ros.solver.slam.update.grown_edges import carried_over
from rotavg_ros.view_graph import ViewGraph

# Units of work per edge, for each part of an update that is not counted elsewhere.
_EDGE = 0.002
# Stands for an unknown label; larger than any label, so that it loses against a known one of the same segment.
UNKNOWN = 2.0


class Labelled(NamedTuple):
    """The known labels of a graph of M edges.

    Attributes:
        trusted: ``(m,)`` labels of its first edges: 1 for good closures and sound odometry, 0 for others, or
            :data:`UNKNOWN`.
        noise: noise of that labelling, to begin with.
        calibration: what to remove from the measurements, if anything.
        by_places: whether the labels were decided by translations, too; rotations alone then must not change them.
    """

    trusted: np.ndarray
    noise: Noise
    calibration: Calibration | None
    by_places: bool


class SolvedFrom(NamedTuple):
    """The result of a solve from labels.

    Attributes:
        published: the answer, by rotations alone.
        mode: the labelling, with FineNet's noise.
        trusted: ``(M,)`` labels of all edges.
        noise: noise before FineNet.
    """

    published: Published
    mode: Mode
    trusted: np.ndarray
    noise: Noise


def solved_from(
    labelled: Labelled, graph: ViewGraph, networks: tuple[SlamCleanNet, SlamFineNet], body_from_world: Tensor
) -> SolvedFrom:
    """Solve a graph some or all of whose labels are known.

    Args:
        labelled: the known labels.
        graph: N nodes.
        networks: CleanNet and FineNet; FineNet is applied once.
        body_from_world: ``(N, 4)`` start; it also decides the labels that are not known.
    """
    drawn = Drawn.of(graph, networks[0], calibration=labelled.calibration)
    problem = drawn.problem
    spend(_EDGE * graph.num_edges)
    before = carried_over(labelled.trusted, problem.graph, UNKNOWN)
    is_new = before == UNKNOWN
    correction = problem.graph.corrections(body_from_world).numpy().T
    common = np.zeros((problem.system(labelled.noise).num_runs, 3))
    trusted, others = np.minimum(before, 1.0), Others.before_any(len(before))
    start = State(np.ascontiguousarray(correction), common, trusted, labelled.noise, others)
    spend(_EDGE * graph.num_edges)
    start = replace(start, trusted=np.where(is_new, relabelled(problem, start), before))
    search = Search(problem)
    mode = search.polished(start, "update")
    if not labelled.by_places:
        mode = search.flipped(mode)
    fine = fine_tuned(mode, networks[1], passes=1)
    published = publish(problem, [fine])
    spend(_EDGE * graph.num_edges)
    return SolvedFrom(published, fine, problem.graph.edge_values(mode.state.trusted, 1.0), mode.state.noise)
