"""The peers by name: what each needs installed, and its answers, new or kept from an earlier run."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rotavg_ros.evaluation import peers
from rotavg_ros.evaluation.kept_answers import kept
from rotavg_ros.evaluation.peers import PeerAnswer, PeerError
from rotavg_ros.view_graph import ViewGraph


class Peer(NamedTuple):
    """An independent implementation and the package on PyPI that has it."""

    package: str
    solve: Callable[[ViewGraph], PeerAnswer]


PEERS = {
    "colmap": Peer("pycolmap", peers.colmap),
    "shonan": Peer("gtsam", peers.shonan),
    "gnc": Peer("gtsam", peers.gnc),
    "isam2": Peer("gtsam", peers.isam2_huber),
}


def is_available(name: str) -> bool:
    """Whether what a contender needs is installed; what is no peer needs nothing."""
    return name not in PEERS or importlib.util.find_spec(PEERS[name].package) is not None


def peer_solver(name: str, keep: Path | None = None) -> Callable[[ViewGraph], PeerAnswer | None]:
    """Solves a view-graph as the peer does; None where the peer gives up.

    Args:
        keep: folder of answers, to be found again by a later run.

    Raises:
        PeerError: the peer is not installed.
    """
    package, solve = PEERS[name]
    if not is_available(name):
        raise PeerError(f"method {name!r} needs {package}, which is not installed; run: pip install {package}")

    def attempt(graph: ViewGraph) -> PeerAnswer | None:
        try:
            return solve(graph)
        except PeerError:
            return None

    return kept(name, attempt, PeerAnswer, keep, peers.__name__, package)
