"""When a node has come to rest: not while a tick with what came last goes on, however long that takes."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")

from rotavg_ros.ros.harness.recorder import Recorder

pytestmark = pytest.mark.ros

# The node with a solver that takes as long as a file says "compile".
COMPILING = """
import sys, time
from pathlib import Path
import rotavg_ros.solver
from rotavg_ros.ros.node.main import main
order, solve = Path(sys.argv.pop(1)), rotavg_ros.solver.solve

def compiling(*arguments, **options):
    while order.read_text() == "compile":
        time.sleep(0.05)
    return solve(*arguments, **options)

rotavg_ros.solver.solve = compiling
sys.exit(main())
"""
PATIENCE_S = 300.0


def test_a_node_whose_final_answer_is_of_before_the_last_inputs_is_not_at_rest(live_node, tmp_path: Path) -> None:
    order = tmp_path / "order"
    order.write_text("work")
    every_message = "keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solver_process:=false"
    live_node.start(*every_message, command=[sys.executable, "-c", COMPILING, order])
    live_node.turn(0, 10)
    live_node.wait_for_silence()
    order.write_text("compile")
    live_node.turn(10, 15)
    live_node.spin_until(lambda: live_node.status["keyframes"] == "15")
    with Recorder() as recorder:
        while len(recorder.reports) < 4:
            recorder.spin(0.1)
            assert live_node.process.is_running and not recorder.is_at_rest
        assert recorder.last_report["answer cold"] == "true"
        order.write_text("work")
        end = time.monotonic() + PATIENCE_S
        while not recorder.is_at_rest:
            recorder.spin(0.1)
            assert live_node.process.is_running and time.monotonic() < end
        answer = recorder.answer()
        assert answer is not None and len(answer.keyframe_ids) == 15
