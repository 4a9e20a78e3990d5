"""The methods that NeuRoRA is compared with, each written from its own paper, behind one signature.

None of them scores edges; ``residual_score`` makes a score of the residuals that they leave.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from rotavg_ros.baselines.arrigoni import arrigoni
from rotavg_ros.baselines.chatterjee import chatterjee
from rotavg_ros.baselines.geman_mcclure import geman_mcclure
from rotavg_ros.baselines.wang import wang
from rotavg_ros.baselines.weiszfeld import weiszfeld
from rotavg_ros.solver.neurora.scores import residual_score
from rotavg_ros.view_graph import ViewGraph

# A graph on the CPU and, for a warm start, the body_from_world (N, 4) of another method → body_from_world (N, 4)
# float64. Every connected component is solved by itself, in a gauge of its own. Rejected edges take no part.
Baseline = Callable[[ViewGraph, Tensor | None], Tensor]

BASELINES: dict[str, Baseline] = {
    "chatterjee": chatterjee,
    "geman-mcclure": geman_mcclure,
    "weiszfeld": weiszfeld,
    "arrigoni": arrigoni,
    "wang": wang,
}

__all__ = ["BASELINES", "Baseline", "arrigoni", "chatterjee", "geman_mcclure", "residual_score", "wang", "weiszfeld"]
