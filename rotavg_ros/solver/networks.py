"""All networks of the package by name, and how to read networks trained elsewhere."""

from __future__ import annotations

from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.network_store import (
    WEIGHTS_FOLDER,
    StoredNetwork,
    forget_networks,
    load_network,
    read_network,
)
from rotavg_ros.solver.neurora.paper import PaperCleanNet, PaperFineNet
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.network import SlamCleanNet

__all__ = [
    "NETWORKS",
    "WEIGHTS_FOLDER",
    "CleanNet",
    "FineNet",
    "PaperCleanNet",
    "PaperFineNet",
    "forget_networks",
    "load_network",
    "read_network",
]

NETWORKS: dict[str, type[StoredNetwork]] = {
    kind.NAME: kind for kind in (CleanNet, FineNet, PaperCleanNet, PaperFineNet, SlamCleanNet, SlamFineNet)
}
