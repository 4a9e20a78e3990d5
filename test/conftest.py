"""Fixtures for all tests: the development data, and a ROS domain that no other program uses."""

from __future__ import annotations

import atexit
import os
import random
import shutil
import signal
import socket
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import settings

# A shell that runs the tests in the background lets its children ignore SIGINT, which the tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).resolve().parent.parent
MAX_THREADS = 2


def free_domain_id() -> int:
    """A ROS domain id on which no participant of this machine listens at the moment."""
    # Up to 101, beyond which DDS ports would collide with the system's ephemeral ones; in random order, so that
    # two test runs that start at the same time choose different ones.
    for domain in random.sample(range(1, 102), 101):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", 7400 + 250 * domain))  # the domain's discovery port
            except OSError:
                continue
            return domain
    raise RuntimeError("every ROS domain id from 1 to 101 is in use on this machine")


# Before anything imports rclpy, and for every process that a test starts: nothing leaves this machine.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="rotavg-test-log-")
atexit.register(shutil.rmtree, os.environ["ROS_LOG_DIR"], ignore_errors=True)
os.environ["MPLBACKEND"] = "Agg"

# No test measures wall-clock time, hypothesis' deadline per example included.
settings.register_profile("rotavg", deadline=None)
settings.load_profile("rotavg")

torch.set_num_threads(min(MAX_THREADS, os.cpu_count() or 1))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the development data, which is not part of the repository."""
    folder = Path(os.environ.get("ROTAVG_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no development data in {folder}; set ROTAVG_DATA to its folder")
    return folder
