"""What of a solve's memory can be written down: which edges of a robot's graph were held good, and by what noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rotavg_ros.view_graph import ViewGraph

_NAMES = ("trusted", "noise", "calibration", "places", "pose_noise", "search")
# What each tick sends from the solver's process to the node's is worth a millisecond.
_TYPES = {"places": np.float32}


@dataclass(frozen=True)
class KeptLabels:
    """In the place of a memory they lead at once to about what the solve said that they are of.

    What is of edges is NaN where nobody has looked.

    Attributes:
        graph: whose first M edges they are of.
        trusted: ``(M,)`` 1 for good closures and sound odometry, 0 for others.
        noise: ``(n,)`` parameters of rotations' noise, in the solver's order.
        calibration: ``(6,)`` rad per step that was taken out of the odometry, and rad out of the closures; ``(0,)`` if
            nothing was.
        places: ``(R, M)`` float32 chances of what closures' places may be, and their weights, in the solver's order.
        pose_noise: ``(m,)`` parameters of the noise of poses, likewise; ``(0,)`` if translations had no say.
        search: ``(3,)`` closures that the last whole search had, those not explained since, and 1 if another answer was
            nearly as likely, else 0: what tells when the next one is due.
    """

    graph: ViewGraph
    trusted: np.ndarray
    noise: np.ndarray
    calibration: np.ndarray
    places: np.ndarray
    pose_noise: np.ndarray
    search: np.ndarray

    @property
    def labels(self) -> KeptLabels:
        """Themselves, as a memory has them."""
        return self

    @property
    def by_places(self) -> bool:
        """Whether translations had a say."""
        return len(self.pose_noise) > 0

    def are_known(self, num_edges: int) -> np.ndarray:
        """``(M',)`` bool, of a graph of so many edges, which somebody has looked at."""
        return np.append(~np.isnan(self.trusted), np.zeros(num_edges - len(self.trusted), dtype=bool))

    def arrays(self) -> dict[str, np.ndarray]:
        """All but the graph."""
        return {name: getattr(self, name) for name in _NAMES}

    @classmethod
    def of_arrays(cls, graph: ViewGraph, arrays: Mapping[str, Any]) -> KeptLabels:
        """What :meth:`arrays` gave, of the first edges of a graph.

        Raises:
            KeyError: an array is missing.
            ValueError: they have no such shapes or values.
        """
        found = cls(graph, *(np.asarray(arrays[name], _TYPES.get(name, np.float64)) for name in _NAMES))
        trusted, noise, places = found.trusted, (found.noise, found.pose_noise, found.search), found.places
        is_flat = all(numbers.ndim == 1 for numbers in (trusted, *noise)) and found.calibration.shape in {(0,), (6,)}
        if (
            not is_flat
            or len(found.search) != 3
            or len(trusted) > graph.num_edges
            or places.ndim != 2
            or places.shape[1] != len(trusted)
        ):
            raise ValueError("labels that fit no graph")
        if ((trusted < 0) | (trusted > 1)).any() or ((places < 0) | np.isinf(places)).any():
            raise ValueError("labels beyond 0 to 1")
        numbers = np.concatenate(noise)
        if not (np.isfinite(numbers) & (numbers >= 0)).all() or not np.isfinite(found.calibration).all():
            raise ValueError("noise below 0, or a calibration that is no number")
        return found

    def of_edges(self, edges: np.ndarray, num_edges: int) -> dict[str, np.ndarray]:
        """Arrays of a graph of so many edges, of which the first M here are ``edges`` ``(M,)``."""
        trusted = np.full(num_edges, np.nan)
        places = np.full((len(self.places), num_edges), np.nan, _TYPES["places"])
        trusted[edges], places[:, edges] = self.trusted, self.places
        return self.arrays() | {"trusted": trusted, "places": places}
