"""Several robots: three of them in processes of their own, each with a node, and a node for the fleet; neighbours."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rotavg_msgs.msg import AbsoluteOrientations

pytestmark = pytest.mark.ros

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "three_robots.py"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
JOINED_ERROR_DEG = 5.0  # a closure's own error is 1°, that of a robot's odometry by the end about 8°


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("three_robots", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def spoken(live_node) -> Iterator[dict[str, list]]:
    """Messages by topic, of the nodes that the example starts."""
    heard: dict[str, list] = {}

    def listen(kind: type, topic: str, qos: object) -> None:
        live_node.probe.create_subscription(kind, topic, heard.setdefault(topic, []).append, qos)

    for name in ("a", "b", "c", "fleet"):
        listen(AbsoluteOrientations, f"/{name}/abs_orientations", LATCHED)
    listen(DiagnosticArray, "/diagnostics", 100)
    return heard


def rotations(answer: AbsoluteOrientations) -> Rotation:
    return Rotation.from_quat(np.asarray(answer.orientations).reshape(-1, 4))


@pytest.mark.large
def test_three_robots_in_three_processes_and_a_node_that_listens_to_all(
    live_node, spoken, example, start_process
) -> None:
    live_node.process = process = start_process(sys.executable, EXAMPLE)
    live_node.spin_until(lambda: "mean error" in process.output, timeout=300)
    assert process.wait() == 0
    run = example.drive()

    for name in "abc":  # in its namespace, a robot's own node knows of nobody else
        assert {tuple(answer.robots) for answer in spoken[f"/{name}/abs_orientations"]} <= {(name,), ()}
    answers = spoken["/fleet/abs_orientations"]
    components = [len(set(answer.components)) for answer in answers]
    apart = [index for index, number in enumerate(components) if number == 3]
    assert apart and components[-1] == 1 and sorted(components[apart[-1] :], reverse=True) == components[apart[-1] :]

    # Each component keeps its gauge until it is joined: the first keyframe stays where odometry began.
    for index in apart:
        first = [list(answers[index].keyframe_robots).index(robot) for robot in range(3)]
        assert rotations(answers[index])[first].magnitude().max() < 1e-6
    assert rotations(answers[-1])[0].magnitude() < 1e-6

    # One frame for all: turned by one rotation they are all near the truth; before the join they cannot be.
    truth = {
        name: Rotation.from_quat(run.world_from_body[k * example.POSES : (k + 1) * example.POSES])
        for k, name in enumerate("abc")
    }

    def worst_deg(estimates: list[tuple[str, int, Rotation]]) -> float:
        """Mean error of the worst robot, seen from the first estimate's."""
        name, step, reference = estimates[0]
        frame = truth[name][step] * reference.inv()
        errors: dict[str, list[float]] = {}
        for name, step, estimate in estimates:
            error = ((frame * estimate).inv() * truth[name][step]).magnitude()
            errors.setdefault(name, []).append(np.degrees(error))
        return max(float(np.mean(each)) for each in errors.values())

    def keyframes(answer: AbsoluteOrientations) -> list[tuple[str, int, Rotation]]:
        steps = np.rint((np.asarray(answer.stamps_ns) - example.START_NS) / example.PERIOD_NS).astype(int)
        names = [answer.robots[robot] for robot in answer.keyframe_robots]
        return list(zip(names, steps.tolist(), rotations(answer), strict=True))

    assert worst_deg(keyframes(answers[-1])) < JOINED_ERROR_DEG < worst_deg(keyframes(answers[apart[-1]]))
    statuses = [status for message in spoken["/diagnostics"] for status in message.status]
    fleet = [
        {pair.key: pair.value for pair in status.values} for status in statuses if status.name.startswith("fleet/")
    ]
    assert int(fleet[-1]["joins"]) in (1, 2) and fleet[-1]["components"] == "1"
    assert fleet[-1]["lost messages"] == "0" and "are joined" in process.output
    assert {status.name for status in statuses} == {f"{name}/rotavg: estimator" for name in ("a", "b", "c", "fleet")}


@pytest.mark.large
def test_nodes_of_other_domains_hear_nothing(live_node, start_process, monkeypatch, other_domain_id) -> None:
    """Two nodes, same names, same topics: only the domain keeps them apart."""
    live_node.start()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(other_domain_id))
    start_process(Path(sys.executable).with_name("rotavg_node"))
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=other_domain_id)
    elsewhere = rclpy.create_node("elsewhere", context=context)
    said: list[DiagnosticArray] = []
    elsewhere.create_subscription(DiagnosticArray, "/diagnostics", said.append, 10)
    executor = rclpy.executors.SingleThreadedExecutor(context=context)
    executor.add_node(elsewhere)
    try:
        for second in range(3):
            message = Odometry()
            message.header.stamp = Time(sec=second)
            live_node.odometry.publish(message)

        def both_have_reported() -> bool:
            executor.spin_once(timeout_sec=0.05)
            return len(said) > 1 and live_node.status["odometry messages"] == "3"

        live_node.spin_until(both_have_reported)
        values = {pair.key: pair.value for pair in said[-1].status[0].values}
        assert values["odometry messages"] == "0" and values["keyframes"] == "0"
        assert elsewhere.count_publishers("/odom") == 0 and live_node.probe.count_subscribers("/odom") == 1
    finally:
        executor.shutdown()
        elsewhere.destroy_node()
        rclpy.shutdown(context=context)
