"""The problems to solve: cases, and the kinds of cases that a suite draws."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.datasets.simulation.synthetic import SFM_OUTLIER_ANGLE, NoiseCovariance
from rotavg_ros.metrics import true_edge_noise
from rotavg_ros.rotations import rotate
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG, FALSE_CLOSURE_M, ViewGraph


@dataclass(frozen=True)
class Family:
    """The differences between photo collections and robots' graphs.

    Attributes:
        profile: of :func:`rotavg_ros.solver.solve`.
        outlier_angle: rad; an edge with more noise is an outlier.
        undecided: rad; edges whose noise lies between the two do not count in verdicts.
        trusts_odometry: whether odometry is known to be good and not judged; otherwise kinds of edges are ignored.
    """

    profile: str
    outlier_angle: float
    undecided: tuple[float, float]
    trusts_odometry: bool


SFM = Family("sfm", float(SFM_OUTLIER_ANGLE), (float(SFM_OUTLIER_ANGLE),) * 2, trusts_odometry=False)
# Closures within 2° of the border between good and false do not count.
SLAM = Family(
    "slam",
    float(np.radians(FALSE_CLOSURE_DEG)),
    (float(np.radians(8.0)), float(np.radians(12.0))),
    trusts_odometry=True,
)


# Closures with translation errors between these do not count, since a recorded truth may be off by as much.
UNDECIDED_METRES = (1.5, 4.0)


@dataclass(frozen=True)
class PoseTruth:
    """The known truth about positions (N nodes, M edges).

    Attributes:
        position: ``(N, 3)`` metres in the truth's world frame; NaN rows where unknown.
        sigma: ``(M, 2)`` rad and metres per component, of each edge's actual noise (for false closures: of good ones).
        stated: ``(M, 2)`` likewise, as the edges state.
        floor: metres; in ratios of errors, smaller errors count as this.
    """

    position: Tensor
    sigma: Tensor
    stated: Tensor
    floor: float = 0.05


class CaseKey(NamedTuple):
    """The unique key of a case in a run.

    Attributes:
        name: of the graph: a data set's, or that of one drawing.
        kind: what was drawn: a recipe, or a change to the graph; empty if there is only one kind.
        seed: of the drawing.
    """

    name: str
    kind: str = ""
    seed: int = 0

    def __str__(self) -> str:
        return f"{self.name}, {self.kind}, seed {self.seed}" if self.kind else self.name


@dataclass(frozen=True)
class Case:
    """A view-graph to be solved, and the known truth about it (N nodes, M edges).

    Attributes:
        key: its name, kind and seed.
        graph: the edges.
        truth: body_from_world ``(N, 4)``, the reference for errors; NaN rows where unknown.
        family: photo collections or robots' graphs.
        intact: ``(M,)`` bool, edges that were left as they were when the graph was spoiled; None: it was not.
        floor: rad; in ratios of errors, smaller errors count as this, since the truth is no better.
        true_precision: ``(M,)`` rad⁻², of each edge's actual noise, if known from the drawing.
        poses: positions, by which closures are judged, too; None: only rotations are known.
        noise_covariance: true covariances of the edges' noise; None: unknown.
    """

    key: CaseKey
    graph: ViewGraph
    truth: Tensor
    family: Family = SFM
    intact: Tensor | None = None
    floor: float = 0.0
    true_precision: Tensor | None = None
    poses: PoseTruth | None = None
    noise_covariance: NoiseCovariance | None = None

    @cached_property
    def noise(self) -> Tensor:
        """``(M,)`` rad, true noise of every edge; NaN where unknown."""
        return true_edge_noise(self.graph, self.truth)

    @cached_property
    def place_error(self) -> Tensor:
        """``(M,)`` metres, error of every edge's translation; NaN where unknown."""
        translation = self.graph.translation
        if self.poses is None or translation is None:
            return torch.full_like(self.noise, torch.nan)
        shift = self.poses.position[self.graph.target] - self.poses.position[self.graph.source]
        error: Tensor = (rotate(self.truth[self.graph.source], shift) - translation).norm(dim=1)
        return error

    @property
    def is_inlier(self) -> Tensor:
        """``(M,)`` bool, the edges that an oracle knows to be good: intact ones, or those with little noise."""
        if self.intact is not None:
            return self.intact
        return ~self.is_closure | ((self.noise <= self.family.outlier_angle) & ~self._is_elsewhere(FALSE_CLOSURE_M))

    @property
    def is_closure(self) -> Tensor:
        """``(M,)`` bool: the edges that may be false: all, except odometry where that is trusted."""
        return ~self.graph.is_odometry | (not self.family.trusts_odometry)

    @property
    def is_false(self) -> Tensor:
        """``(M,)`` bool: edges that are clearly outliers."""
        is_false = (self.noise > self.family.undecided[1]) | (self.place_error > UNDECIDED_METRES[1])
        return self.is_closure & is_false

    @property
    def is_good(self) -> Tensor:
        """``(M,)`` bool: edges that are clearly good, excluding random ones that happen to fit."""
        is_good = (self.noise <= self.family.undecided[0]) & ~self._is_elsewhere(UNDECIDED_METRES[0])
        return self.is_closure & self.is_inlier & is_good

    def _is_elsewhere(self, metres: float) -> Tensor:
        """``(M,)`` bool: translations with a larger error, or with an unknown one where positions are judged."""
        if self.poses is None:
            return torch.zeros_like(self.is_closure)
        return ~(self.place_error <= metres)


@dataclass(frozen=True)
class Kind:
    """A kind of cases.

    Attributes:
        name: of the kind.
        draw: seed → case, the same in every call; None if the kind is impossible on this seed's graph.
        is_random: whether seeds differ; otherwise one drawing is enough.
    """

    name: str
    draw: Callable[[int], Case | None]
    is_random: bool = True


def num_drawings(kinds: Iterable[Kind], seeds: Sequence[int]) -> int:
    """Largest number of cases that :func:`drawings` yields; it leaves out those that cannot be drawn."""
    return sum(len(set(seeds)) if kind.is_random else 1 for kind in kinds)


def drawings(kinds: Iterable[Kind], seeds: Sequence[int]) -> Iterator[Case]:
    """Every kind with every seed, drawn on demand. Named twice is named once."""
    once = tuple(dict.fromkeys(seeds))
    for kind in kinds:
        for seed in once if kind.is_random else once[:1]:
            case = kind.draw(seed)
            if case is not None:
                yield case


def warm_up_case(family: Family) -> Case:
    """A tiny graph without noise, on which one-time costs (imports, weights, first kernels) are paid."""
    identity = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).expand(4, 4)
    kind = [0, 0, 0, 1] if family is SLAM else None
    graph = ViewGraph.create([0, 1, 2, 0], [1, 2, 3, 3], identity, kind=kind)
    return Case(CaseKey("warm-up"), graph, identity, family)
