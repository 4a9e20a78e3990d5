"""Other starts than CleanNet, tree and FineNet, where few edges check each other.

One wrong edge in a tree turns all that is behind it, and where cameras have few edges the refinement may stay in that
valley. So it begins at several places, of which few steps tell the best (``refinement.py``).
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.stages import apply_labels, trust_all
from rotavg_ros.solver.neurora.tree import bootstrap
from rotavg_ros.solver.sfm.cycles.evidence import by_triangles
from rotavg_ros.solver.sfm.refinement import Start
from rotavg_ros.solver.sfm.starts.spectral import spectral
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Of cameras with fewer edges, in the mean, other starts cost little, and few edges check each other.
_SPARSE_DEGREE = 20


def is_sparse(graph: ViewGraph) -> bool:
    """Whether so few edges check each other that CleanNet may lead into another valley."""
    return 2 * graph.num_edges < _SPARSE_DEGREE * graph.num_nodes


def other_starts(judged: Cleaned, is_believed: bool, body_from_world: Tensor, component: Tensor) -> list[Start]:
    """By a tree that trusts all edges alike, by triangles where CleanNet had the word, and by eigenvectors.

    Args:
        judged: N nodes, M edges with CleanNet's word and labels, as they are in canonical form.
        is_believed: whether that word stood.
        body_from_world: ``(N, 4)`` the first start.
        component: ``(N,)`` of every node.
    """
    graph = judged.measured
    verdicts = [apply_labels(trust_all(graph), graph.label)]
    if is_believed:
        verdicts.append(by_triangles(judged, component))
    starts = [Start(bootstrap(of, component).body_from_world, 1 - of.outlier_probability) for of in verdicts]
    allowed = (graph.label != EdgeLabel.REJECTED).double()
    starts.append(Start(spectral(graph, body_from_world, component, allowed), torch.ones_like(allowed)))
    return starts
