"""What must not knock the node over: malformed messages, floods, mistakes at the start, bad moments to end."""

from __future__ import annotations

import itertools
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from rotavg_msgs.msg import KeyframeReference, RelativeRotation, RelativeRotationArray
from std_srvs.srv import SetBool

import rotavg_ros
from rotavg_ros.inputs import Source
from rotavg_ros.inputs.rotavg import edge_from_message
from rotavg_ros.online import Answer, OnlineEstimator
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.settings.text import to_yaml

pytestmark = pytest.mark.ros

NODE = Path(sys.executable).with_name("rotavg_node")
EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
LENGTH = 40
NAN, INF = math.nan, math.inf


def rotation(index: int) -> Rotation:
    return Rotation.from_rotvec([0.1, 0, 0.2 * index])


def message_of(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def odometry(index: int) -> Odometry:
    message = Odometry()
    message.header.stamp = Time(sec=1000 + index)
    message.pose.pose.orientation = message_of(rotation(index))
    return message


def closure(edge_id: int, source: int, target: int) -> RelativeRotation:
    ends = [
        KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=Time(sec=1000 + index)) for index in (source, target)
    ]
    return RelativeRotation(
        id=edge_id,
        source=ends[0],
        target=ends[1],
        rotation=message_of(rotation(source).inv() * rotation(target)),
        kind=RelativeRotation.LOOP_CLOSURE,
    )


def malformed(kind: str, draw: random.Random) -> RelativeRotation:
    """A closure that is good but for one thing."""
    source = draw.randrange(0, 20)
    edge = closure(1_000_000 + draw.randrange(2**60), source, source + draw.randrange(1, 15))
    quaternion, end = edge.rotation, draw.choice((edge.source, edge.target))
    if kind == "nan_rotation":
        setattr(quaternion, draw.choice("xyzw"), draw.choice((NAN, INF, -INF, 1e300)))
    elif kind == "zero_quaternion":
        edge.rotation = Quaternion(x=0.0, y=0.0, z=0.0, w=draw.choice((0.0, 1e-300, 1e-9)))
    elif kind == "unnormalized_quaternion":
        factor = draw.choice((0.5, 0.99, 1.01, 1e6))
        edge.rotation = Quaternion(
            x=quaternion.x * factor, y=quaternion.y * factor, z=quaternion.z * factor, w=quaternion.w * factor
        )
    elif kind == "bad_kind":
        edge.kind = draw.randrange(2, 256)
    elif kind == "bad_precision":
        edge.precision = draw.choice((NAN, INF, -INF, -1.0, -1e-300))
    elif kind == "bad_reference":
        end.by = draw.randrange(2, 256)
    elif kind == "bad_stamp":
        end.stamp = draw.choice((Time(sec=-5), Time(sec=1010, nanosec=2**32 - 1)))
    elif kind == "stamp_out_of_range":
        end.stamp = Time(sec=draw.randrange(1, 999))
    elif kind == "self_edge":
        edge.target = edge.source
    return edge


KINDS = (
    "nan_rotation",
    "zero_quaternion",
    "unnormalized_quaternion",
    "bad_kind",
    "bad_precision",
    "bad_reference",
    "bad_stamp",
    "stamp_out_of_range",
    "self_edge",
)


def feed_good(live_node, start: int, stop: int) -> None:
    for index in range(start, stop):
        live_node.odometry.publish(odometry(index))
        if index >= 20:
            live_node.edges.publish(closure(index, index - 20, index))


def malformed_odometry(kind: str, draw: random.Random) -> Odometry:
    """Odometry that goes on from nothing, for one reason or another."""
    message = odometry(draw.randrange(LENGTH))
    quaternion = message.pose.pose.orientation
    if kind == "nan_rotation":
        setattr(quaternion, draw.choice("xyzw"), draw.choice((NAN, INF)))
    elif kind == "zero_quaternion":
        message.pose.pose.orientation = Quaternion(w=0.0)
    elif kind == "unnormalized_quaternion":
        quaternion.y += 2.0
    elif kind == "bad_stamp":
        message.header.stamp = draw.choice((Time(sec=-5), Time(sec=1010, nanosec=2**32 - 1)))
    elif kind == "out_of_order_odometry":
        message.header.stamp = Time(sec=draw.randrange(1, 999))
    elif kind == "future_stamp":
        message.header.stamp = Time(sec=draw.randrange(10**6, 2**31))
    return message


ODOMETRY_KINDS = (
    *("nan_rotation", "zero_quaternion", "unnormalized_quaternion", "bad_stamp"),
    *("out_of_order_odometry", "future_stamp"),
)


def answer_to_good_stream() -> Answer:
    """What comes of :func:`feed_good` alone, in this process."""
    every_message = NodeParameters().changed({"keyframe_angle_deg": 0.0, "keyframe_distance_m": 0.0})
    online = OnlineEstimator(every_message.estimator)
    for index in range(LENGTH):
        online.add_odometry("robot", (1000 + index) * 10**9, rotation(index).as_quat().tolist())
        if index >= 20:
            assert online.add_edge(edge_from_message(closure(index, index - 20, index), Source("robot"))) is None
    answer = online.tick(force_cold=True)
    assert answer is not None
    return answer


# The node with a solver that never comes out of its warm-up, once it has noted that it is in it.
STARTING = """
import sys, time
from pathlib import Path
import rotavg_ros.solver
from rotavg_ros.ros.node.main import main
note = Path(sys.argv.pop(1))

def never(*arguments, **options):
    note.touch()
    while True:
        time.sleep(0.05)

rotavg_ros.solver.solve = never
sys.exit(main())
"""


def test_a_node_that_is_starting_ends_at_once(start_process, wait_until, tmp_path: Path) -> None:
    note, state_file = tmp_path / "warming up", tmp_path / "state.npz"
    options = [word for option in ("solver_process:=false", f"state_file:={state_file}") for word in ("-p", option)]
    node = start_process(sys.executable, "-c", STARTING, note, "--ros-args", *options)
    wait_until(note.exists, node)
    assert node.stop(signal.SIGTERM, timeout=60.0) == 0
    assert list(tmp_path.glob("*state.npz*")) == []
    assert "Traceback" not in node.output


def test_a_thousand_malformed_messages_are_counted_by_reason_and_change_nothing(live_node) -> None:
    """Mixed into a good stream, on every topic."""
    live_node.start(*EVERY_MESSAGE, "pending_capacity:=1000")
    draw = random.Random(5)
    per_kind = 100
    edges = [malformed(kind, draw) for kind in KINDS for _ in range(per_kind)]
    ghosts = [closure(10**9 + index, 0, 1) for index in range(100)]  # they wait for what never comes
    for index, edge in enumerate(ghosts):
        edge.target = KeyframeReference(robot=f"ghost {index}" if index % 2 else "", id=2**64 - 2 - index)
    edges += ghosts
    draw.shuffle(edges)
    broken = [malformed_odometry(draw.choice(ODOMETRY_KINDS), draw) for _ in range(100)]
    rounds = 50
    for number in range(rounds):
        if number < LENGTH:
            feed_good(live_node, number, number + 1)
        some = edges[number::rounds]
        live_node.arrays.publish(RelativeRotationArray(edges=some[::2]))
        for edge in some[1::2]:
            live_node.edges.publish(edge)
        for message in broken[number::rounds]:
            live_node.odometry.publish(message)
        live_node.spin_for(0.01)
    live_node.spin_until(lambda: live_node.status.get("dropped") == str(len(KINDS) * per_kind + len(broken)))
    assert live_node.status["pending"] == str(len(ghosts)) and live_node.status["time jumps"] == "0"
    counted = {key: int(value) for key, value in live_node.status.items() if key.startswith("dropped ")}
    assert all(counted[f"dropped {kind}"] == per_kind for kind in set(KINDS) - set(ODOMETRY_KINDS))
    of_odometry = {kind: counted[f"dropped {kind}"] - per_kind * (kind in KINDS) for kind in ODOMETRY_KINDS}
    assert sum(of_odometry.values()) == len(broken) and min(of_odometry.values()) > 0

    answer, expected = live_node.wait_for_silence(), answer_to_good_stream()
    assert list(answer.keyframe_ids) == expected.keyframe_id.tolist()
    assert sorted(live_node.flags[-1].edge_ids) == sorted(expected.edge_id.tolist())
    np.testing.assert_allclose(np.reshape(answer.orientations, (-1, 4)), expected.world_from_body, atol=1e-6)
    assert "Traceback" not in live_node.process.output


def test_malformed_odometry_is_counted_and_changes_nothing(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed_good(live_node, 0, LENGTH)
    before = live_node.wait_for_silence()
    number, expected = len(live_node.orientations), {}
    for index, reason in enumerate(
        ("nan_rotation", "zero_quaternion", "unnormalized_quaternion", "out_of_order_odometry", "repeated_stamp")
    ):
        message = odometry(LENGTH + index)
        if reason == "nan_rotation":
            message.pose.pose.orientation.y = NAN
        elif reason == "zero_quaternion":
            message.pose.pose.orientation.w = message.pose.pose.orientation.x = 0.0
            message.pose.pose.orientation.y = message.pose.pose.orientation.z = 0.0
        elif reason == "unnormalized_quaternion":
            message.pose.pose.orientation.w += 0.1
        elif reason == "out_of_order_odometry":
            message.header.stamp = Time(sec=1005)
        else:
            message.header.stamp = Time(sec=1000 + LENGTH - 1)
        for _ in range(3):
            live_node.odometry.publish(message)
        expected[f"dropped {reason}"] = "3"
    live_node.spin_until(lambda: expected.items() <= live_node.status.items())
    assert live_node.answers[-1] == before and len(live_node.orientations) == number
    feed_good(live_node, LENGTH, LENGTH + 5)
    assert len(live_node.wait_for_silence().keyframe_ids) == LENGTH + 5


@pytest.mark.large
def test_edges_to_what_never_comes_wait_within_bounds(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "pending_capacity:=100", "pending_timeout_s:=20.0")
    feed_good(live_node, 0, 10)
    for edge_id in range(150):
        edge = closure(edge_id, 0, 1)
        edge.target = KeyframeReference(id=10**12 + edge_id)
        live_node.edges.publish(edge)
    live_node.spin_until(lambda: live_node.status.get("dropped pending_overflow") == "50")
    assert live_node.status["pending"] == "100"
    for index in range(10, LENGTH):
        live_node.odometry.publish(odometry(index))
    live_node.spin_until(lambda: live_node.status.get("dropped pending_timeout") == "100")
    assert live_node.status["pending"] == "0"


@pytest.mark.large
def test_a_full_graph_goes_on_and_what_is_left_is_right(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "max_keyframes:=30")
    for index in range(100):
        live_node.odometry.publish(odometry(index))
        if index % 10 == 9:
            live_node.edges.publish(closure(index, index - 9, index))
    live_node.spin_until(lambda: live_node.status.get("odometry messages") == "100")
    answer = live_node.wait_for_silence()
    ids = list(answer.keyframe_ids)
    assert len(ids) <= 30 and ids[0] == 0 and ids[-1] == 99
    orientations = Rotation.from_quat(np.array(answer.orientations).reshape(-1, 4))
    truth = Rotation.concatenate([rotation(index) for index in ids])
    assert (orientations * truth.inv()).magnitude().max() < 1e-6
    assert int(live_node.status["marginalized keyframes"]) >= 70
    live_node.edges.publish(closure(1000, 2, 98))  # one of them is surely gone
    live_node.spin_until(lambda: 1000 in live_node.flags[-1].edge_ids)
    assert len(live_node.answers[-1].keyframe_ids) == len(ids)


def test_a_flood_is_survived_and_every_loss_counted(live_node) -> None:
    """Small queue, best effort: whatever did not come is known to be missing."""
    live_node.start(*EVERY_MESSAGE[:2], "solve_period_s:=0.2", "odometry_queue_depth:=50", reliable_odometry=False)
    sent = 3000
    messages = [odometry(index) for index in range(sent)]
    for message in messages:
        live_node.odometry.publish(message)
    late = itertools.count(1)

    def all_are_accounted_for() -> bool:
        """The last number tells what is missing before it, so send until one gets through after the flood."""
        number = next(late)
        live_node.spin_for(1.0)
        live_node.odometry.publish(odometry(sent + number))
        reports = live_node.reports
        live_node.spin_until(lambda: live_node.reports >= reports + 2)
        counts = ("odometry messages", "lost messages", "missed before first")
        return sum(int(live_node.status[name]) for name in counts) == sent + number

    live_node.spin_until(all_are_accounted_for)
    assert int(live_node.status["ticks"]) > 0


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("keyframe_angle_deg:=fast", "keyframe_angle_deg is 'fast'; it must be a number"),
        ("edge_topics:=['x:nobodys_msgs/msg/Edge']", "nobodys_msgs/msg/Edge"),
        pytest.param("qos_overrides./odom.subscription.depth:=many", "odom", marks=pytest.mark.large),
        pytest.param("odometry_topics:=[]", "odometry_topics is empty", marks=pytest.mark.large),
        pytest.param("use_sim_time:=perhaps", "use_sim_time", marks=pytest.mark.large),
        pytest.param(
            "state_file:=/no/such/folder/state", "there is no folder /no/such/folder", marks=pytest.mark.large
        ),
        pytest.param("world_frame:=''", "world_frame is ''; name the frame", marks=pytest.mark.large),
        pytest.param("weights:=/no/such/folder", "/no/such/folder: has no weights", marks=pytest.mark.large),
    ],
)
def test_a_mistake_at_the_start_is_one_line_and_exit_code_2(parameter: str, message: str) -> None:
    command = [NODE, "--ros-args", "-p", parameter]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2, ended.stderr
    assert message in ended.stderr
    assert ended.stderr.startswith("rotavg_node: error: ") and ended.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-p", "gauge"], "'-p gauge'"),
        (["--params-file", "nothing.yaml"], "nothing.yaml"),
        (["-p", "odometry_topics:=['a topic']"], "topic a topic: "),
    ],
)
def test_mistakes_that_rclpy_finds_name_no_place_in_its_sources(arguments: list[str], message: str) -> None:
    ended = subprocess.run([NODE, "--ros-args", *arguments], capture_output=True, text=True, timeout=300, check=False)
    assert (ended.returncode, ended.stderr.count("\n")) == (2, 1)
    assert message in ended.stderr
    assert "/src/" not in ended.stderr


def test_a_parameter_file_speaks_to_the_node_in_its_namespace(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(to_yaml(NodeParameters(), "/fleet/a/rotavg").replace("gauge: ", "gauge: up # "))
    command = [NODE, "--ros-args", "-r", "__ns:=/fleet/a", "--params-file", path]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr == "rotavg_node: error: gauge is 'up'; choose from odometry, identity\n"


def test_a_foreign_state_file_is_refused_at_the_start(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    np.savez(path, something=np.arange(3))
    content = path.read_bytes()
    command = [NODE, "--ros-args", "-p", f"state_file:={path}"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2 and str(path) in ended.stderr and ended.stderr.count("\n") == 1
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "kind", ["a FIFO", *(pytest.param(kind, marks=pytest.mark.large) for kind in ("a folder", "a device"))]
)
def test_a_state_file_that_is_no_file_is_refused_at_the_start(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "state"
    {"a FIFO": os.mkfifo, "a folder": os.mkdir, "a device": lambda path: path.symlink_to("/dev/null")}[kind](path)
    command = [NODE, "--ros-args", "-p", f"state_file:={path}"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"rotavg_node: error: the state file {path} is {kind}; ")
    assert ended.stderr.count("\n") == 1 and os.listdir(tmp_path) == ["state"]


@pytest.mark.large
def test_two_nodes_on_one_state_file(live_node, tmp_path: Path) -> None:
    """The second is refused, until the first has ended, even by SIGKILL."""
    path = tmp_path / "state" / "state.npz"
    path.parent.mkdir()
    state = f"state_file:={path}"
    live_node.start(*EVERY_MESSAGE, state)
    command = [NODE, "--ros-args", "-p", state, "-r", "__node:=second"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2
    assert f"{path} is in use by another node (process {live_node.process.pid})" in ended.stderr
    assert ended.stderr.startswith("rotavg_node: error: ") and ended.stderr.count("\n") == 1
    live_node.stop(signal.SIGKILL)
    live_node.start(*EVERY_MESSAGE, state)
    # On a busy machine the killed node's endpoints may be found late and pass for the new one's.
    lock = path.with_name(".state.npz.lock")
    live_node.spin_until(lambda: lock.read_text().strip() == str(live_node.process.pid))
    assert live_node.stop() == 0
    assert os.listdir(path.parent) == []


@pytest.mark.large
def test_a_clean_end_during_a_long_solve(live_node) -> None:
    """A graph that takes long to solve; the signal comes a moment after the solve has begun."""
    live_node.start("keyframe_source:=edges", "solve_period_s:=0.05")
    draw = np.random.default_rng(0)
    edges = []
    for index in range(6000):
        edge = closure(index, 0, 1)
        ends = (index, index + 1) if index < 4000 else draw.choice(4000, 2, replace=False).tolist()
        edge.source, edge.target = (KeyframeReference(id=node) for node in ends)
        edge.kind = RelativeRotation.ODOMETRY if index < 4000 else RelativeRotation.LOOP_CLOSURE
        edge.rotation = message_of(Rotation.from_rotvec(draw.normal(0, 0.5, 3)))
        edges.append(edge)
    live_node.arrays.publish(RelativeRotationArray(edges=edges))
    live_node.spin_until(lambda: live_node.status.get("edges") == "6000")
    started = time.monotonic()
    assert live_node.stop() == 0
    assert time.monotonic() - started < 30  # the promise is two seconds; a loaded machine must not fail the test
    assert "Traceback" not in live_node.process.output


@pytest.mark.parametrize("package", ["rclpy", "rotavg_msgs", "torch"])
def test_without_a_package_it_is_one_line(package: str) -> None:
    hidden = f"import sys; sys.modules[{package!r}] = None; from rotavg_ros.ros.node.main import main; sys.exit(main())"
    ended = subprocess.run([sys.executable, "-c", hidden], capture_output=True, text=True, timeout=300, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith(f"rotavg_node: error: there is no Python package {package}; source ROS 2's setup.sh")
    assert ended.stderr.count("\n") == 1


@pytest.mark.large
def test_a_huge_array_silences_nothing(live_node) -> None:
    """Reports come, odometry is answered and services are served while it is taken, and single edges stay behind it."""
    live_node.start("keyframe_source:=edges", "solve_period_s:=3600.0", "odometry_timeout_s:=1000.0")
    length, single = 100_000, 150
    ends = [KeyframeReference(id=index) for index in range(2)]
    repeated = RelativeRotation(source=ends[0], target=ends[1], rotation=message_of(rotation(1)))
    live_node.arrays.publish(RelativeRotationArray(edges=[repeated] * length))
    for index in range(single):
        live_node.edges.publish(closure(index, 0, 0))
    live_node.spin_until(lambda: int(live_node.status.get("dropped duplicate_edge", 0)) > 0)
    reports, seen = live_node.reports, []
    while int(live_node.status["dropped duplicate_edge"]) < length - 1:
        live_node.odometry.publish(odometry(len(seen)))
        live_node.spin_until(lambda: live_node.reports > reports + len(seen))
        seen.append(int(live_node.status["dropped duplicate_edge"]))
        assert len(live_node.orientations) >= len(seen) - 1
    assert len(seen) > 2 and live_node.call("pause", SetBool, data=True).success
    live_node.spin_until(lambda: live_node.status.get("dropped self_edge") == str(single))
    assert live_node.status["lost messages"] == "0"


@pytest.mark.parametrize("damage", ["truncated", pytest.param("another version", marks=pytest.mark.large)])
def test_networks_that_cannot_be_used_are_told_at_the_start(tmp_path: Path, damage: str) -> None:
    """A copy of the package with damaged weights, started as it is."""
    package = shutil.copytree(Path(rotavg_ros.__file__).parent, tmp_path / "rotavg_ros")
    weights = package / "solver" / "weights" / "slam-clean-net.safetensors"
    content = weights.read_bytes()
    if damage == "truncated":
        weights.write_bytes(content[: len(content) // 2])
    else:
        stated = {"network": "slam-clean-net", "architecture_version": "0"}
        safetensors.torch.save_file(safetensors.torch.load(content), weights, stated)
    command = [sys.executable, "-c", "import sys; from rotavg_ros.ros.node.main import main; sys.exit(main())"]
    ended = subprocess.run(
        command,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2, ended.stderr
    line = next(line for line in ended.stderr.splitlines() if str(weights) in line)
    assert "rotavg train" in line
    assert "Traceback" not in ended.stderr
