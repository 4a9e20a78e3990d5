"""Synthetic rotations on the topology of a real view-graph: who sees whom is real, orientations and noise are drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rotavg_ros.datasets.graph_file import GraphFileError, reading
from rotavg_ros.datasets.synthetic import PaperRecipe, ReleasedRecipe, SyntheticGraph, measured


@dataclass(frozen=True)
class Topology:
    """Which of N cameras are joined by M edges.

    Attributes:
        num_nodes: N.
        source, target: ``(M,)`` int64 in 0 … N-1.
    """

    num_nodes: int
    source: np.ndarray
    target: np.ndarray

    def sample(self, recipe: ReleasedRecipe | PaperRecipe, rng: np.random.Generator) -> SyntheticGraph:
        """Draw orientations and noise by ``recipe``; its own numbers of cameras and pairs play no part."""
        orientation = recipe.orientations(self.num_nodes, rng)
        return measured(orientation, self.source, self.target, recipe.noise(len(self.source), rng))


def read_topology(path: str | Path) -> Topology:
    """Read an npz archive with ``nodes`` (their number), ``source`` and ``target``. Self-edges are left out.

    Raises:
        GraphFileError: naming what is at fault.
    """
    path = Path(path)
    with reading(path):
        file = path.open("rb")
    with file:
        try:
            with np.load(file, allow_pickle=False) as archive:
                num_nodes = int(archive["nodes"])
                source, target = (archive[name].astype(np.int64) for name in ("source", "target"))
        except KeyError as error:
            raise GraphFileError.at(path, None, f"not a topology: {error.args[0]}") from None
        except Exception as error:  # a damaged archive can fail anywhere in zipfile, zlib or the array headers
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise GraphFileError.at(path, None, f"not a readable npz archive of plain arrays: {reason}") from None
    ends = np.stack((source, target)) if source.shape == target.shape and source.ndim == 1 else None
    if ends is None or ((ends < 0) | (ends >= num_nodes)).any():
        what = f"source and target must be equally many nodes in 0 … {num_nodes - 1}"
        raise GraphFileError.at(path, None, what)
    proper = source != target
    return Topology(num_nodes, source[proper], target[proper])
