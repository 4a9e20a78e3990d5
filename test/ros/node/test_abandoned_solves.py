"""Reset, load and pause do not wait for a running solve, over DDS; the solve ends soon, and nobody hears of it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from geometry_msgs.msg import Quaternion
from rotavg_msgs.msg import KeyframeReference, RelativeRotation, RelativeRotationArray
from std_srvs.srv import SetBool, Trigger

from rotavg_ros.ros.node.diagnostics import KEPT

pytestmark = pytest.mark.ros

EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")

# The node with a solver that notes what becomes of it. While a file says "block" it waits until it is abandoned; while
# it says "repeat" it solves again and again, so that it is in the middle of a solve whenever it is abandoned.
NOTING = """
import sys, time
from pathlib import Path
import rotavg_ros.solver
from rotavg_ros.ros.node.main import main
from rotavg_ros.solver.running.work import Abandoned, stop_if_abandoned
notes, order, solve = Path(sys.argv.pop(1)), Path(sys.argv.pop(1)), rotavg_ros.solver.solve

def note(what):
    with notes.open("a") as file:
        print(what, file=file)

def noting(*arguments, **options):
    note("begun")
    try:
        while order.read_text() == "block":
            stop_if_abandoned()
            time.sleep(0.01)
        solution = solve(*arguments, **options)
        while order.read_text() == "repeat":
            solve(*arguments, **options)
    except Abandoned:
        note("abandoned")
        raise
    note("ended")
    return solution

rotavg_ros.solver.solve = noting
sys.exit(main())
"""


class NotingNode:
    """A :class:`LiveNode` whose solver is the one above."""

    def __init__(self, live_node, folder: Path) -> None:
        self.live, self._notes, self.order = live_node, folder / "notes", folder / "order"
        self._notes.touch()
        self.order.write_text("work")

    def start(self, *parameters: str) -> None:
        command = [sys.executable, "-c", NOTING, self._notes, self.order]
        self.live.start(*parameters, "solver_process:=false", command=command)  # it notes what this process solves

    def notes(self) -> list[str]:
        return self._notes.read_text().split()

    def block(self) -> None:
        """Have the next solve block, and wait until it does."""
        self.order.write_text("block")
        begun = self.notes().count("begun")
        self.live.turn(int(self.live.status.get("keyframes", 0)), int(self.live.status.get("keyframes", 0)) + 5)
        self.live.spin_until(lambda: self.notes().count("begun") > begun)


@pytest.fixture
def noting(live_node, tmp_path: Path) -> NotingNode:
    return NotingNode(live_node, tmp_path)


@pytest.mark.parametrize(
    "service", ["reset", *(pytest.param(name, marks=pytest.mark.large) for name in ("load", "pause"))]
)
def test_services_answer_while_a_solve_blocks_and_have_it_end(noting: NotingNode, tmp_path: Path, service: str) -> None:
    live = noting.live
    noting.start(*EVERY_MESSAGE, f"state_file:={tmp_path / 'state.npz'}")
    live.turn(0, 10)
    live.wait_for_silence()
    assert live.call("save").success
    noting.block()
    answers, ended = len(live.answers), noting.notes().count("ended")
    response = live.call("pause", SetBool, data=True) if service == "pause" else live.call(service)
    assert response.success and noting.notes().count("ended") == ended
    live.spin_until(lambda: noting.notes()[-1] == "abandoned" or noting.notes()[-2:] == ["abandoned", "begun"])
    if service != "pause":
        live.spin_until(lambda: len(live.answers) > answers)
    live.spin_for(1.0)
    heard = [len(answer.keyframe_ids) for answer in live.answers[answers:]]
    assert heard == ([] if service == "pause" else [0])  # nothing but that the earlier answers are no more
    noting.order.write_text("work")
    live.call("pause", SetBool, data=False)
    live.turn(15, 20)
    expected = {"reset": 5, "load": 15, "pause": 20}[service]
    live.spin_until(lambda: live.status.get("keyframes") == str(expected))
    assert len(live.wait_for_silence().keyframe_ids) == expected
    assert live.status["solve failures"] == "0"
    # What was forgotten or replaced is backed up, and the diagnostics tell of it for a minute.
    assert (KEPT in live.status["message"]) == (service != "pause")


@pytest.mark.large
def test_who_waits_for_an_answer_is_told_that_it_was_abandoned(noting: NotingNode) -> None:
    live = noting.live
    noting.start(*EVERY_MESSAGE[:2], "solve_period_s:=3600.0")
    live.turn(0, 10)
    live.spin_until(lambda: live.status.get("keyframes") == "10")
    noting.order.write_text("block")
    client = live.probe.create_client(Trigger, "/rotavg/solve_now")
    live.spin_until(client.service_is_ready)
    waiting = client.call_async(Trigger.Request())
    live.spin_until(lambda: noting.notes()[-1:] == ["begun"])
    assert live.call("pause", SetBool, data=True).success and not waiting.done()  # somebody has asked for it
    live.turn(10, 20)
    live.spin_until(lambda: len(live.orientations) == 20)  # nothing else waits
    assert live.call("reset").success
    live.spin_until(waiting.done)
    assert not waiting.result().success and "abandoned" in waiting.result().message
    assert noting.notes()[-2:] == ["begun", "abandoned"]
    nothing = live.call("solve_now")
    assert nothing.success and "no keyframes" in nothing.message


@pytest.mark.large
def test_a_large_solve_stops(noting: NotingNode, large_array: Callable[[], RelativeRotationArray]) -> None:
    live = noting.live
    noting.start("keyframe_source:=edges", "solve_period_s:=3600.0")
    live.arrays.publish(large_array())
    live.spin_until(lambda: live.status.get("edges") == "12000")
    live.spin_until(lambda: noting.notes()[-1:] != ["begun"])  # a first tick may have met the first edges
    noting.order.write_text("repeat")
    client = live.probe.create_client(Trigger, "/rotavg/solve_now")
    live.spin_until(client.service_is_ready)
    client.call_async(Trigger.Request())
    live.spin_until(lambda: noting.notes()[-1:] == ["begun"])
    assert live.call("reset").success
    live.spin_until(lambda: noting.notes()[-1] == "abandoned")
    live.turn(0, 3)
    live.spin_until(lambda: live.status.get("keyframes") == "0" and live.status["level"] == "0")


@pytest.fixture
def large_array() -> Callable[[], RelativeRotationArray]:
    """A function that makes an array of 4000 poses with 8000 closures between any two of them, all of it noise."""

    def make() -> RelativeRotationArray:
        draw = np.random.default_rng(0)
        source = np.concatenate((np.arange(4000), draw.integers(0, 4000, 8000)))
        target = np.concatenate((np.arange(1, 4001), (source[4000:] + draw.integers(1, 4000, 8000)) % 4000))
        edges = []
        for index, rotation in enumerate(Rotation.random(12_000, random_state=0).as_quat().tolist()):
            ends = [KeyframeReference(id=int(end)) for end in (source[index], target[index])]
            kind = RelativeRotation.ODOMETRY if index < 4000 else RelativeRotation.LOOP_CLOSURE
            x, y, z, w = rotation
            rotation_message = Quaternion(x=x, y=y, z=z, w=w)
            edges.append(
                RelativeRotation(id=index, source=ends[0], target=ends[1], rotation=rotation_message, kind=kind)
            )
        return RelativeRotationArray(edges=edges)

    return make


@pytest.mark.large
def test_a_parameter_set_on_an_empty_graph_breaks_nothing(live_node) -> None:
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    live_node.start(*EVERY_MESSAGE, "odometry_timeout_s:=1000.0")

    def set_threshold(value: float) -> None:
        parameter = Parameter("outlier_threshold", value=value).to_parameter_msg()
        (result,) = live_node.call("set_parameters", SetParameters, parameters=[parameter]).results
        assert result.successful
        nothing = live_node.call("solve_now")
        assert nothing.success and "no keyframes" in nothing.message
        live_node.said.clear()
        live_node.spin_until(lambda: len(live_node.said) >= 3)
        assert all("solv" not in message and "stale" not in message for _, message in live_node.said)

    set_threshold(0.4)
    live_node.turn(0, 10)
    live_node.wait_for_silence()
    assert live_node.call("reset").success
    set_threshold(0.6)
    assert live_node.status["solve failures"] == "0" and "solving failed" not in live_node.process.output
