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
# The last of a domain's ports: of its 120th participant. Who holds it has the domain, before any participant is there.
_CLAIM_PORT = _PORTS_PER_DOMAIN - 1


def claim_domain_id(candidates: Iterable[int] | None = None) -> int:
    """The first of the candidates on which nobody of this machine listens; no other caller gets it from now on.

    The claim ends with this process (and with those that it forks). Participants that are told the domain by hand do
    not ask for it.

    Args:
        candidates: default: all, in random order.

    Raises:
        RuntimeError: all are in use.
    """
    for domain in random.sample(DOMAIN_IDS, len(DOMAIN_IDS)) if candidates is None else candidates:
        claim = _bound(_port(domain, _CLAIM_PORT))
        if claim is None:
            continue
        if all(_is_free(_port(domain, offset)) for offset in _DISCOVERY_PORTS):
            claim.detach()  # nothing closes it but the end of the process
            return domain
        claim.close()
    raise RuntimeError("every ROS domain id that may be used is in use on this machine")


def _port(domain: int, offset: int) -> int:
    return _BASE_PORT + _PORTS_PER_DOMAIN * domain + offset


def _is_free(port: int) -> bool:
    probe = _bound(port)
    if probe is None:
        return False
    probe.close()
    return True


def _bound(port: int) -> socket.socket | None:
    """A socket that alone listens on the port; None if another one does."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listener.bind(("", port))
    except OSError:
        listener.close()
        return None
    return listener
