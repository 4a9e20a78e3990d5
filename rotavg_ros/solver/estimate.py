"""Input and output of the solve of either profile."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from torch import Tensor

from rotavg_ros.solver.neurora.network_store import Networks


@dataclass(frozen=True)
class Estimate:
    """Result of a profile's solve: orientations in any gauge, scores, variance in rad² (NaN: unknown).

    ``memory`` is what makes the profile's next solve of the same graph, grown a little, cheaper; nobody else reads it.
    ``warnings`` say why it should not be trusted, a sentence each. ``places`` are there where translations are known.
    ``restated`` are edges ``(n,)`` that are made of others and were not judged.
    ``step_variance`` is how far a step of odometry errs, rad² per component. ``is_anew`` says that it is what a solve
    without a memory leads to.
    """

    body_from_world: Tensor
    outlier_score: Tensor
    variance: Tensor
    memory: object | None = None
    warnings: tuple[str, ...] = ()
    places: Places | None = None
    step_variance: float = math.nan
    is_anew: bool = True
    restated: Tensor | None = None


@dataclass(frozen=True)
class Places:
    """Results that need translations (N nodes, M edges): positions in the orientations' frame, and verdicts on edges.

    Attributes:
        position: ``(N, 3)`` metres.
        variance: ``(N,)`` m² per component, relative to the component's first node.
        rotation_score: ``(M,)`` probability that an edge's rotation is wrong; its outlier score counts its place, too.
        precision: ``(M, 2)`` rad⁻² and m⁻² per component, weights of the edges; 0 where nothing is known.
    """

    position: Tensor
    variance: Tensor
    rotation_score: Tensor
    precision: Tensor


@dataclass
class Stopwatch:
    """Seconds of wall-clock time by stage; one that runs several times adds up."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@dataclass(frozen=True)
class Run:
    """Arguments of a profile's solve besides the graph and the stages to run.

    Attributes:
        networks: the networks' source and device.
        watch: measures the seconds of the stages.
        refinement_steps: maximum number, 0 for none; None: the stages' own number.
        warm_start: ``(N, 4)`` body_from_world to begin with instead of the tree's.
        memory: memory of the profile's last solve by the same method, or its labels alone; the graph may differ.
        work: units that an update may spend; it leaves the rest for later. None: no limit.
        anew: an update is to arrive at the answer of a solve without a memory.
    """

    networks: Networks
    watch: Stopwatch
    refinement_steps: int | None = None
    warm_start: Tensor | None = None
    memory: object | None = None
    work: float | None = None
    anew: bool = False
