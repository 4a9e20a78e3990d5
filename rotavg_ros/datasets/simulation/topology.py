"""Topologies of view-graphs without rotations: those of real graphs, and random ones of their kind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from rotavg_ros.datasets.files.graph_file import GraphFileError, reading
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe, SyntheticGraph, measured


@dataclass(frozen=True)
class Topology:
    """The topology of N cameras joined by M edges.

    Attributes:
        num_nodes: N.
        source, target: ``(M,)`` int64 in 0 … N-1.
    """

    num_nodes: int
    source: np.ndarray
    target: np.ndarray

    def sample(self, recipe: ReleasedRecipe | PaperRecipe, rng: np.random.Generator) -> SyntheticGraph:
        """Draw orientations and noise by ``recipe``; its own numbers of cameras and pairs are ignored."""
        orientation = recipe.orientations(self.num_nodes, rng)
        return measured(orientation, self.source, self.target, recipe.noise(len(self.source), rng))


def read_topology(path: str | Path) -> Topology:
    """Read an npz archive with ``nodes`` (their number), ``source`` and ``target``. Self-edges are left out.

    Raises:
        GraphFileError: the message names the fault.
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


@dataclass(frozen=True)
class ClusteredTopology:
    """A generator of topologies like those of photo collections: dense clusters and a fringe of few edges.

    Cameras stand in clusters on a plane; some see far less than others. Pairs are the closest and best-seeing ones.
    With these ranges, mean degree (10–50 % of the cameras), its quartiles, the clustering coefficient (0.5–0.8) and the
    depth (3–8) are about those of the 1DSfM scenes.

    Attributes:
        clusters: number of clusters.
        separation: distance of the clusters' centres in units of their radius.
        fringe: how unequally cameras see.
        pair_share: share of all pairs that are joined.
    """

    clusters: tuple[int, int] = (1, 5)
    separation: tuple[float, float] = (0.5, 2.0)
    fringe: tuple[float, float] = (0.5, 2.5)
    pair_share: tuple[float, float] = (0.1, 0.5)

    def sample(self, num_nodes: int, rng: np.random.Generator) -> Topology:
        """Draw a connected topology."""
        count = int(rng.integers(self.clusters[0], self.clusters[1] + 1))
        centre = rng.uniform(*self.separation) * rng.standard_normal((count, 2))
        member = rng.choice(count, num_nodes, p=rng.dirichlet(np.full(count, 2.0)))
        position = centre[member] + rng.standard_normal((num_nodes, 2))
        blindness = rng.exponential(rng.uniform(*self.fringe), num_nodes)
        first, second = np.triu_indices(num_nodes, k=1)
        distance = blindness[first] + blindness[second] + ((position[first] - position[second]) ** 2).sum(axis=1)
        distance += rng.logistic(0, 0.5, len(first))
        distance -= distance.min() - 1
        wanted = int(rng.uniform(*self.pair_share) * len(first))
        kept = np.zeros(len(first), dtype=bool)
        kept[np.argpartition(distance, wanted)[:wanted]] = True
        # A tree that keeps the graph connected.
        tree = minimum_spanning_tree(coo_array((distance, (first, second)), shape=(num_nodes, num_nodes))).tocoo()
        low, high = np.minimum(tree.row, tree.col), np.maximum(tree.row, tree.col)
        kept |= np.isin(first * num_nodes + second, low.astype(np.int64) * num_nodes + high)
        return Topology(num_nodes, first[kept], second[kept])
