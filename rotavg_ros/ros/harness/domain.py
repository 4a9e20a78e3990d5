"""ROS domains that nobody on this machine uses."""

from __future__ import annotations

import random
import socket
from collections.abc import Iterable

# Beyond 101, DDS ports would collide with the system's ephemeral ones.
DOMAIN_IDS = range(1, 102)
# From the RTPS specification: the ports on which a domain's participants listen for each other. All of them use the
# first (except those confined to this machine), and each of the first few uses one of the others.
_BASE_PORT, _PORTS_PER_DOMAIN = 7400, 250
_DISCOVERY_PORTS = (0, 10, 12, 14)


def free_domain_id(candidates: Iterable[int] | None = None) -> int:
    """The first of the candidates on which no participant of this machine listens at the moment.

    Args:
        candidates: default: all, in random order, so that two processes that choose at once choose differently.

    Raises:
        RuntimeError: all are in use.
    """
    for domain in random.sample(DOMAIN_IDS, len(DOMAIN_IDS)) if candidates is None else candidates:
        if all(_is_free(_BASE_PORT + _PORTS_PER_DOMAIN * domain + offset) for offset in _DISCOVERY_PORTS):
            return domain
    raise RuntimeError("every ROS domain id that may be used is in use on this machine")


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("", port))
        except OSError:
            return False
    return True
