"""What goes between the two processes: plain arrays, pickled."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Sent instead of a request: the running solve is no longer wanted.
ABANDON = b""
# Sent instead of a graph's routes: those of the request before.
KNOWN = "known"


@dataclass
class Request:
    """A request for a solve.

    Attributes:
        number: counts the requests.
        graph: a :class:`ViewGraph`'s fields, or :data:`KNOWN` for its routes.
        warm_start: ``(N, 4)``.
        remembered: number of the solve whose memory may be used.
        options: of :func:`rotavg_ros.solve`.
        labels: what is left of a memory that the other side does not have: arrays of
            :class:`rotavg_ros.solver.KeptLabels`, and a :class:`ViewGraph`'s fields.
    """

    number: int
    graph: dict[str, Any]
    warm_start: np.ndarray | None
    remembered: int | None
    options: dict[str, Any]
    labels: tuple[dict[str, np.ndarray], dict[str, Any]] | None = None


@dataclass
class Advance:
    """A request to continue the work that a solve has left.

    Attributes:
        remembered: number of the solve.
        work: units of work that may be spent.
    """

    remembered: int
    work: float


def to_arrays(content: Any) -> dict[str, Any]:
    """A dataclass's fields, with arrays for tensors."""
    values = {each.name: getattr(content, each.name) for each in fields(content)}
    return {name: value.cpu().numpy() if isinstance(value, Tensor) else value for name, value in values.items()}


def from_arrays(values: dict[str, Any]) -> dict[str, Any]:
    """The same with tensors for arrays."""
    return {name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value for name, value in values.items()}
