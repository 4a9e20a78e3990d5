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

# Units of work for each edge, of each part of what an update does beside all that others count.
_EDGE = 0.002
# In the place of a label that is not known; more than any.
UNKNOWN = 2.0


class Labelled(NamedTuple):
    """What is known of a graph of M edges.

    Attributes:
        trusted: ``(m,)`` of its first edges, 1 for good closures and sound odometry, 0 for others, :data:`UNKNOWN`.
        noise: of that labelling, to begin with.
        calibration: what to take out of all measurements of a kind, if anything.
        by_places: whether translations have told the labels, which rotations alone must not change then.
    """

    trusted: np.ndarray
    noise: Noise
    calibration: Calibration | None
    by_places: bool


class SolvedFrom(NamedTuple):
    """What it leads to.

    Attributes:
        published: the answer, by rotations alone.
        mode: the labelling, with noise as FineNet has it.
        trusted: ``(M,)``, of all edges.
        noise: before FineNet.
    """

    published: Published
    mode: Mode
    trusted: np.ndarray
    noise: Noise


def solved_from(
    labelled: Labelled, graph: ViewGraph, networks: tuple[SlamCleanNet, SlamFineNet], body_from_world: Tensor
) -> SolvedFrom:
    """Solve a graph, some or all of whose labels are known.

    Args:
        labelled: what is known of it.
        graph: N nodes.
        networks: CleanNet and FineNet, which is applied once.
        body_from_world: ``(N, 4)`` start, by which closures whose labels are not known are judged.
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
    return SolvedFrom(published, fine, problem.graph.edge_values(mode.state.trusted), mode.state.noise)
