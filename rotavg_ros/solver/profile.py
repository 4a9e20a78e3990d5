"""What the solves of both profiles give and need: estimates, networks, a stopwatch."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from rotavg_ros.solver.network_store import load_network
from rotavg_ros.solver.slam_memory import SlamMemory


@dataclass(frozen=True)
class Estimate:
    """What a profile's solve gives: orientations in any gauge, scores, variance in rad² (NaN: unknown)."""

    body_from_world: Tensor
    outlier_score: Tensor
    variance: Tensor
    memory: SlamMemory | None = None


@dataclass(frozen=True)
class Networks:
    """Where the networks run, and the folder that has those of the user's."""

    device: str
    folder: Path | None

    def load(self, name: str) -> Any:
        if self.folder is not None and (self.folder / f"{name}.safetensors").exists():
            return load_network(name, self.device, self.folder)
        return load_network(name, self.device)


@dataclass
class Stopwatch:
    """Seconds of wall-clock time by stage; one that runs several times adds up."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
