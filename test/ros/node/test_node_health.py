"""What the diagnostics say over DDS, each state brought about: silence, contradictions, a solver that fails."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from rotavg_msgs.msg import KeyframeReference, RelativeRotation

pytestmark = pytest.mark.ros

EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
OK, WARN, ERROR = 0, 1, 2

# The node with a solver that does what a file says: "fail", "hang", "hang after an answer", or else its work.
SABOTAGED = """
import sys, time
from pathlib import Path
import rotavg_ros.solver
from rotavg_ros.ros.node.main import main
order, solve, advance = Path(sys.argv.pop(1)), rotavg_ros.solver.solve, rotavg_ros.solver.advance

def sabotaged(*arguments, **options):
    if order.read_text() == "fail":
        raise RuntimeError("the factorisation broke down")
    while order.read_text() == "hang":
        time.sleep(0.05)
    return solve(*arguments, **options)

def sabotaged_after(*arguments):
    while order.read_text() == "hang after an answer":
        order.with_name("hangs").touch()
        time.sleep(0.05)
    return advance(*arguments)

rotavg_ros.solver.solve, rotavg_ros.solver.advance = sabotaged, sabotaged_after
sys.exit(main())
"""


def says(live_node, level: int, *words: str) -> None:
    """Wait for the next report of this level with these words in its message."""

    def heard() -> bool:
        while live_node.said:
            said_level, message = live_node.said.pop(0)
            if said_level == level and all(word in message for word in words):
                return True
        return False

    live_node.spin_until(heard)


def test_silence_refusals_and_contradictions_are_warned_of_and_pass(live_node) -> None:
    # A period that no solve exceeds on a busy machine, which would be warned of for a minute.
    live_node.start(*EVERY_MESSAGE, "solve_period_s:=1.0", "odometry_timeout_s:=5.0")
    says(live_node, WARN, "no odometry yet")
    live_node.turn(0, 20)
    says(live_node, OK, "ok")
    says(live_node, WARN, "no odometry for")
    live_node.odometry.publish(Odometry())  # a quaternion of zeros, stamped 1970
    live_node.turn(20, 30)
    says(live_node, WARN, "1 inputs refused")
    for edge_id in range(12):  # closures that contradict odometry and each other
        ends = [KeyframeReference(id=index) for index in (edge_id, 29 - edge_id)]
        x, y, z, w = Rotation.random(random_state=edge_id).as_quat().tolist()
        rotation = Quaternion(x=x, y=y, z=z, w=w)
        live_node.edges.publish(RelativeRotation(id=edge_id, source=ends[0], target=ends[1], rotation=rotation, kind=1))
    says(live_node, WARN, "loop closures are flagged as false")
    assert live_node.call("reset").success
    live_node.turn(0, 20)
    says(live_node, OK, "ok")


def test_a_solver_that_fails_or_hangs_stops_nothing_else(live_node, tmp_path: Path) -> None:
    order = tmp_path / "order"
    order.write_text("work")
    # A period that no solve exceeds on a busy machine, which would be warned of for a minute.
    options = (*EVERY_MESSAGE, "solver_process:=false", "solve_period_s:=1.0", "odometry_timeout_s:=1000.0")
    live_node.start(*options, command=[sys.executable, "-c", SABOTAGED, order])
    live_node.turn(0, 10)
    live_node.wait_for_silence()
    order.write_text("fail")
    live_node.turn(10, 20)
    says(live_node, ERROR, "solving fails: the factorisation broke down")
    refused = live_node.call("solve_now")
    assert not refused.success and "factorisation" in refused.message
    live_node.spin_until(lambda: len(live_node.orientations) == 20)
    order.write_text("work")
    says(live_node, OK, "ok")
    assert int(live_node.status["solve failures"]) > 0 and len(live_node.wait_for_silence().keyframe_ids) == 20
    assert "Traceback" not in live_node.process.output

    order.write_text("hang after an answer")
    live_node.spin_until(order.with_name("hangs").exists)
    live_node.turn(20, 30)
    says(live_node, ERROR, "the answer is stale")
    order.write_text("work")
    says(live_node, OK, "ok")

    order.write_text("hang")
    live_node.turn(30, 40)
    says(live_node, ERROR, "the answer is stale")
    live_node.spin_until(lambda: len(live_node.orientations) == 40)
    assert live_node.stop(signal.SIGTERM) == 0
    assert "Traceback" not in live_node.process.output
