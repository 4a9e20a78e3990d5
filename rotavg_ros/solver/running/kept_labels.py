"""The part of a solve's memory that can be written to a file: the labels of a robot's edges, and the noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE, ViewGraph

_NAMES = ("trusted", "noise", "calibration", "bias_axis", "places", "pose_noise", "search")
# Single precision saves a millisecond: each tick sends these from the solver's process to the node's.
_TYPES = {"places": np.float32}


@dataclass(frozen=True)
class KeptLabels:
    """Labels of a solve. Given in place of its memory, they lead at once to about the same solution.

    Values of edges that no solve has judged are NaN.

    Attributes:
        graph: its first M edges have the labels.
        trusted: ``(M,)`` 1 for good closures and sound odometry, 0 for others.
        noise: ``(n,)`` parameters of rotations' noise, in the solver's order.
        calibration: ``(6,)`` gyroscope bias that was taken out of the odometry, rad per step, and error of the mounting
            that was taken out of the closures, rad; ``(0,)`` if nothing was.
        bias_axis: ``(3,)`` unit vector of the body, about which alone the bias may be; ``(0,)``: about any.
        places: ``(R, M)`` float32 probabilities of what closures' places may be, and their weights, in the solver's
            order.
        pose_noise: ``(m,)`` parameters of the noise of poses, likewise; ``(0,)`` if translations were not used.
        search: ``(3,)`` number of closures in the last whole search, number of closures not explained since, and 1 if
            another answer was nearly as likely, else 0; they decide when the next search is due.
    """

    graph: ViewGraph
    trusted: np.ndarray
    noise: np.ndarray
    calibration: np.ndarray
    bias_axis: np.ndarray
    places: np.ndarray
    pose_noise: np.ndarray
    search: np.ndarray

    @property
    def labels(self) -> KeptLabels:
        """The labels themselves; a memory has the same attribute."""
        return self

    @property
    def by_places(self) -> bool:
        """Whether translations were used."""
        return len(self.pose_noise) > 0

    def are_known(self, num_edges: int) -> np.ndarray:
        """``(M',)`` bool, edges that a solve has judged, in a graph of ``num_edges``."""
        return np.append(~np.isnan(self.trusted), np.zeros(num_edges - len(self.trusted), dtype=bool))

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything but the graph."""
        return {name: getattr(self, name) for name in _NAMES}

    @classmethod
    def of_arrays(cls, graph: ViewGraph, arrays: Mapping[str, Any]) -> KeptLabels:
        """From what :meth:`arrays` returned, for the first edges of a graph.

        Raises:
            KeyError: an array is missing.
            ValueError: shapes or values are impossible.
        """
        found = cls(graph, *(np.asarray(arrays[name], _TYPES.get(name, np.float64)) for name in _NAMES))
        trusted, noise, places = found.trusted, (found.noise, found.pose_noise, found.search), found.places
        calibration, axis = found.calibration, found.bias_axis
        is_flat = all(numbers.ndim == 1 for numbers in (trusted, *noise)) and calibration.shape in {(0,), (6,)}
        if (
            not is_flat
            or axis.shape not in {(0,), (3,)}
            or len(found.search) != 3
            or len(trusted) > graph.num_edges
            or places.ndim != 2
            or places.shape[1] != len(trusted)
        ):
            raise ValueError("labels that fit no graph")
        if ((trusted < 0) | (trusted > 1)).any() or ((places < 0) | np.isinf(places)).any():
            raise ValueError("labels beyond 0 to 1")
        numbers = np.concatenate(noise)
        if not (np.isfinite(numbers) & (numbers >= 0)).all() or not np.isfinite(calibration).all():
            raise ValueError("noise below 0, or a calibration that is no number")
        if len(axis) and not abs(np.linalg.norm(axis) - 1) <= UNIT_NORM_TOLERANCE:
            raise ValueError("an axis that is no unit vector")
        return found

    def of_edges(self, edges: np.ndarray, num_edges: int) -> dict[str, np.ndarray]:
        """Arrays for a graph of ``num_edges``, in which the M edges here have the indices ``edges`` ``(M,)``."""
        trusted = np.full(num_edges, np.nan)
        places = np.full((len(self.places), num_edges), np.nan, _TYPES["places"])
        trusted[edges], places[:, edges] = self.trusted, self.places
        return self.arrays() | {"trusted": trusted, "places": places}
