"""The peers by name: the packages that they need, and their answers, new or stored by an earlier run."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import NamedTuple

from rotavg_ros.evaluation.common import peers
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.kept_answers import KeptAnswers
from rotavg_ros.evaluation.common.peers import MissingPeerError, PeerError
from rotavg_ros.view_graph import ViewGraph


class Peer(NamedTuple):
    """An independent implementation and the package on PyPI that has it."""

    package: str
    solve: Callable[[ViewGraph], Answer]


PEERS = {
    "colmap": Peer("pycolmap", peers.colmap),
    "shonan": Peer("gtsam", peers.shonan),
    "gnc": Peer("gtsam", peers.gnc),
    "isam2": Peer("gtsam", peers.isam2_huber),
    "isam2-cauchy": Peer("gtsam", peers.isam2_cauchy),
    "isam2-geman-mcclure": Peer("gtsam", peers.isam2_geman_mcclure),
    "open3d": Peer("open3d", peers.line_process),
}


def is_available(name: str) -> bool:
    """Whether the package that a contender needs is installed; a contender that is not a peer needs none."""
    return name not in PEERS or is_installed(PEERS[name].package)


def is_installed(package: str) -> bool:
    """Whether a package can be found."""
    return importlib.util.find_spec(package) is not None


def missing(name: str, package: str) -> MissingPeerError:
    """The error for a contender whose package is not installed."""
    return MissingPeerError(f"method {name!r} needs {package}, which is not installed; run: pip install {package}")


def peer_solver(name: str, keep: KeptAnswers | None = None) -> Callable[[ViewGraph], Answer | None]:
    """Solves a view-graph with the peer; None if the peer gives up.

    Args:
        keep: stores answers for a later run.

    Raises:
        MissingPeerError: the peer is not installed.
    """
    package, solve = PEERS[name]
    if not is_available(name):
        raise missing(name, package)

    def attempt(graph: ViewGraph) -> Answer | None:
        try:
            return solve(graph)
        except MissingPeerError:
            raise
        except PeerError:
            return None

    return attempt if keep is None else keep.keeping(attempt, name, (peers.__name__,), library=package)
