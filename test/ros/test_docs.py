"""The Python of "Feed it from your SLAM", run as it stands there beside a real node."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry

from .conftest import LiveNode

pytestmark = pytest.mark.ros

PAGE = Path(__file__).resolve().parents[2] / "docs" / "from-your-slam.md"
PUBLISHER, CONSUMER = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def odometry(second: int) -> Odometry:
    """A robot that turns by 30° to the left between the seconds 10 and 50."""
    message = Odometry()
    message.header.stamp = Time(sec=second)
    half = np.radians(30) * (second - 10) / 40 / 2
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = float(np.sin(half)), float(np.cos(half))
    message.pose.pose.position.x = float(second)
    return message


def test_a_front_end_and_a_consumer(
    live_node: LiveNode, start_process: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    live_node.start()
    for second in range(5, 61):
        live_node.odometry.publish(odometry(second))
    (tmp_path / "publisher.py").write_text(PUBLISHER, encoding="utf-8")
    publisher = start_process(sys.executable, tmp_path / "publisher.py")
    live_node.spin_until(lambda: any(1 in flags.edge_ids for flags in live_node.flags))
    assert publisher.wait() == 0, publisher.output
    flags = live_node.flags[-1]
    # Its direction is right: what the odometry says of the same two moments is no contradiction.
    assert flags.scores[list(flags.edge_ids).index(1)] < 0.5

    names: dict[str, Any] = {"node": live_node.probe}
    exec(CONSUMER, names)  # noqa: S102 - the page is ours
    flags.outliers = [edge == 1 for edge in flags.edge_ids]
    names["on_flags"](flags)
    assert capsys.readouterr().out == "take these out of your graph: [1]\n"
