"""Many view-graphs in one call: one pass of the networks over all of them keeps a GPU busy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.solver import warnings
from rotavg_ros.solver.methods import NETWORK_METHODS
from rotavg_ros.solver.pipeline import OUTLIER_ANGLE, solve
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import HoldsViewGraph, ViewGraph, view_graph_of


def solve_batch(
    graphs: Sequence[ViewGraph | HoldsViewGraph],
    *,
    method: str = "neurora",
    profile: str = "auto",
    device: str = "auto",
    refinement_steps: int | None = None,
    weights: Path | None = None,
) -> list[Solution]:
    """Solves every graph as :func:`~rotavg_ros.solver.solve` does; the arguments are the same.

    SfM graphs are solved together as one graph with that many components, and ``stage_seconds`` are those of all. The
    linear systems are iterated until every component has converged, so answers differ from separate solves by the
    refinement's tolerance: up to a tenth of a standard error where cameras have few edges, 10⁻⁵ rad and less elsewhere.
    Their ``warnings`` are those about edges that state nothing, mostly flagged graphs and accepted edges that are far
    off; the warnings that edges which contradict the answer agree among themselves, and that another answer fits nearly
    as well, are given only for graphs solved alone. SLAM graphs, and methods that are not ours, are solved one by one.

    Returns:
        a solution per graph, in their order.

    Raises:
        UserError: as :func:`~rotavg_ros.solver.solve`.
    """
    given = [view_graph_of(graph) for graph in graphs]

    def solve_alone(graph: ViewGraph) -> Solution:
        return solve(
            graph, method=method, profile=profile, device=device, refinement_steps=refinement_steps, weights=weights
        )

    is_sfm = [profile == "sfm" or (profile == "auto" and not bool(graph.is_odometry.any())) for graph in given]
    if not set(method.split("+")) <= set(NETWORK_METHODS) or sum(is_sfm) < 2:
        return [solve_alone(graph) for graph in given]
    together = [graph for graph, joins in zip(given, is_sfm, strict=True) if joins]
    joint = solve(
        _union(together),
        method=method,
        profile="sfm",
        device=device,
        refinement_steps=refinement_steps,
        weights=weights,
    )
    parts = iter(_split(joint, together))
    return [next(parts) if joins else solve_alone(graph) for graph, joins in zip(given, is_sfm, strict=True)]


def _union(graphs: Sequence[ViewGraph]) -> ViewGraph:
    """All graphs side by side, without translations and routes, which the SfM profile does not read."""
    unread = {"num_nodes", "translation", "information", "route", "routes"}
    names = [f.name for f in fields(ViewGraph) if f.name not in unread]
    columns = {name: [getattr(graph, name) for graph in graphs] for name in names}
    if any(graph.information is not None for graph in graphs):
        columns["information"] = [_information_of(graph) for graph in graphs]
    starts = _starts([graph.num_nodes for graph in graphs])
    for end in ("source", "target"):
        columns[end] = [column + start for column, start in zip(columns[end], starts, strict=False)]
    joined = {name: torch.cat([column.cpu() for column in parts]) for name, parts in columns.items()}
    return ViewGraph(num_nodes=starts[-1], **joined)


def _information_of(graph: ViewGraph) -> torch.Tensor:
    """``(M, 3, 3)``, NaN where there is none."""
    if graph.information is not None:
        return graph.information
    return torch.full((graph.num_edges, 3, 3), torch.nan, dtype=torch.float64, device=graph.device)


def _split(joint: Solution, graphs: Sequence[ViewGraph]) -> list[Solution]:
    """The answer to each graph out of the answer to their union."""
    node = _starts([graph.num_nodes for graph in graphs])
    edge = _starts([graph.num_edges for graph in graphs])
    parts = []
    for index, graph in enumerate(graphs):
        nodes, edges = slice(node[index], node[index + 1]), slice(edge[index], edge[index + 1])
        component, on_cpu = joint.component[nodes], graph.to("cpu")
        parts.append(
            Solution(
                joint.body_from_world[nodes],
                joint.outlier_score[edges],
                component - component[:1],  # numbered by first node, so the graph's own numbers follow each other
                joint.uncertainty[nodes],
                joint.stage_seconds,
                joint.method,
                joint.profile,
                joint.device,
                warnings=(
                    *warnings.stating_nothing(on_cpu),
                    *warnings.mostly_flagged(on_cpu, joint.outlier_score[edges]),
                    *warnings.accepted_far_off(on_cpu, joint.body_from_world[nodes], OUTLIER_ANGLE["sfm"]),
                ),
            )
        )
    return parts


def _starts(sizes: list[int]) -> list[int]:
    return [0, *np.cumsum(sizes).tolist()]
