"""Fixtures for all tests: the development data, and a ROS domain that no other program uses."""

from __future__ import annotations

import atexit
import os
import random
import shutil
import signal
import tempfile
import time
from pathlib import Path

import pytest
import torch
from hypothesis import settings

from rotavg_ros.ros.harness.domain import DOMAIN_IDS, claim_domain_id

# A shell that runs the tests in the background lets its children ignore SIGINT, which the tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)
# … and nohup lets them ignore SIGHUP.
signal.signal(signal.SIGHUP, signal.SIG_DFL)

ROOT = Path(__file__).resolve().parent.parent
MAX_THREADS = 2


def own_domain_id() -> int:
    """A ROS domain id that nobody else uses or claims; the processes of one test run (pytest-xdist) divide them up."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", f"{time.time_ns()} {os.getpid()}")
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    return claim_domain_id(random.Random(run).sample(DOMAIN_IDS, len(DOMAIN_IDS))[worker::workers])


# Before anything imports rclpy, and for every process that a test starts: nothing leaves this machine.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_DOMAIN_ID"] = str(own_domain_id())
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="rotavg-test-log-")
atexit.register(shutil.rmtree, os.environ["ROS_LOG_DIR"], ignore_errors=True)
os.environ["MPLBACKEND"] = "Agg"

# No test measures wall-clock time, hypothesis' deadline per example included. New examples come with every run.
settings.register_profile("rotavg", deadline=None, max_examples=30)
settings.load_profile("rotavg")

# Threads of several workers would wait for each other's cores, and torch's do so by spinning.
torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else min(MAX_THREADS, os.cpu_count() or 1))


@pytest.fixture
def other_domain_id() -> int:
    """A ROS domain beside the one that the tests use."""
    return own_domain_id()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the development data, which is not part of the repository."""
    folder = Path(os.environ.get("ROTAVG_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no development data in {folder}; set ROTAVG_DATA to its folder")
    return folder
