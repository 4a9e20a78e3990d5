"""What of a solve's memory can be written down: which edges of a robot's graph were held good, and by what noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class KeptLabels:
    """In the place of a memory they lead at once to about what the solve said that they are of.

    Attributes:
        graph: whose first M edges they are of.
        trusted: ``(M,)`` 1 for good closures and sound odometry, 0 for others, NaN where nobody has looked.
        noise: ``(n,)`` parameters of the noise, in the solver's order.
        bias: ``(3,)`` rad per step that was taken out of the odometry, ``(0,)`` if none was.
        by_places: whether translations had a say.
    """

    graph: ViewGraph
    trusted: np.ndarray
    noise: np.ndarray
    bias: np.ndarray
    by_places: bool

    @property
    def labels(self) -> KeptLabels:
        """Themselves, as a memory has them."""
        return self

    def arrays(self) -> dict[str, np.ndarray]:
        """All but the graph."""
        by_places = np.array(self.by_places)
        return {"trusted": self.trusted, "noise": self.noise, "bias": self.bias, "by_places": by_places}

    @classmethod
    def of_arrays(cls, graph: ViewGraph, arrays: Mapping[str, Any]) -> KeptLabels:
        """What :meth:`arrays` gave, of the first edges of a graph.

        Raises:
            KeyError: an array is missing.
            ValueError: they have no such shapes or values.
        """
        trusted, noise, bias = (np.asarray(arrays[name], dtype=float) for name in ("trusted", "noise", "bias"))
        if trusted.ndim != 1 or len(trusted) > graph.num_edges or noise.ndim != 1 or bias.shape not in {(0,), (3,)}:
            raise ValueError("labels that fit no graph")
        if ((trusted < 0) | (trusted > 1)).any() or not (np.isfinite(noise) & (noise >= 0)).all():
            raise ValueError("labels beyond 0 to 1, or noise below 0")
        if not np.isfinite(bias).all():
            raise ValueError("a bias that is no number")
        return cls(graph, trusted, noise, bias, bool(arrays["by_places"]))
