"""What all peers share: how they are imported, timed and read."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.answers import Clock
from rotavg_ros.view_graph import ViewGraph

# Standard deviation per component assumed for an edge without a stated precision, rad.
DEFAULT_SIGMA = float(np.radians(1.0))
# Quantile of a residual's χ² distribution that is used where a peer needs an outlier threshold.
INLIER_PROBABILITY = 0.99


class PeerError(UserError):
    """A peer that is not installed or that gave no answer."""


class MissingPeerError(PeerError):
    """A peer that cannot be imported; the message says how to install it."""


@contextmanager
def timed(clock: Clock) -> Iterator[None]:
    """Count the time of the peer's own work; its exceptions on giving up become a PeerError."""
    try:
        with clock.running():
            yield
    except RuntimeError as error:  # raised by GTSAM for a linear system without a solution
        raise PeerError(f"the peer gave up: {error}") from None


def load(name: str) -> Any:
    """Import a peer's package.

    Raises:
        MissingPeerError: it is not installed, or lacks something itself.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        raise MissingPeerError(
            f"this comparison needs {name}, which is not installed; run: pip install {name}"
        ) from None
    except ImportError as error:
        raise MissingPeerError(f"{name} is installed but cannot be imported: {error}") from None


def stated_sigma(graph: ViewGraph) -> Tensor:
    """``(M,)`` rad per component, as the edges state it; one degree for those that do not."""
    return torch.where(graph.precision.isnan(), DEFAULT_SIGMA, graph.precision.rsqrt())


def from_rows(quaternions: list[Any]) -> Tensor:
    """Lists of xyzw to ``(N, 4)`` float64 of unit length."""
    return rotations.normalize(torch.tensor(np.array(quaternions, dtype=np.float64).reshape(-1, 4)))
