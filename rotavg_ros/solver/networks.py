"""All networks of the package by name."""

from __future__ import annotations

from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.network_store import StoredNetwork
from rotavg_ros.solver.slam.network import SlamCleanNet

# Folder of the weights that come with the package.
NETWORKS: dict[str, type[StoredNetwork]] = {kind.NAME: kind for kind in (CleanNet, FineNet, SlamCleanNet)}
