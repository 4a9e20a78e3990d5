"""Which topic is used as what, without a word from the user and with some."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from rotavg_ros.bags.answer_messages import orientation_message
from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION, typestore
from rotavg_ros.bags.messages import Edge, Keyframe, edge_message, odometry_message
from rotavg_ros.bags.reader import BagReader
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.replay.options import ReplayOptionError, read_parameter_file, read_settings
from rotavg_ros.replay.plan import Plan, Wishes, make_plan
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.settings.text import to_yaml

IMU = "sensor_msgs/msg/Imu"
VECTOR = "geometry_msgs/msg/Vector3Stamped"
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def imu_message(orientation_is_known: bool):
    types = typestore().types
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    stamped = orientation_message(10**9, (0.0, 0.0, 0.0, 1.0), "imu")
    return types[IMU](
        header=stamped.header,
        orientation=stamped.quaternion,
        orientation_covariance=np.full(9, 0.01 if orientation_is_known else -1.0),
        angular_velocity=zero,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=zero,
        linear_acceleration_covariance=np.zeros(9),
    )


def wind_message():
    """Of a type that a replay has no use for."""
    types = typestore().types
    header = odometry_message(10**9, np.zeros(3), IDENTITY, "map").header
    return types[VECTOR](header=header, vector=types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0))


def relative_rotation(kind: int):
    ends = Keyframe(3, 10**9), Keyframe(4, 10**9 + 5)
    return edge_message(Edge(10**9, 1, 1, *ends, IDENTITY, 100.0, kind))


ODOM = (ODOMETRY, lambda: odometry_message(10**9, np.zeros(3), IDENTITY, "odom"))
CLOSURE = (RELATIVE_ROTATION, lambda: relative_rotation(1))
STEP = (RELATIVE_ROTATION, lambda: relative_rotation(0))
WIND = (VECTOR, wind_message)
GOOD_IMU, BLIND_IMU = (IMU, lambda: imu_message(True)), (IMU, lambda: imu_message(False))


@pytest.fixture
def plan_for(tmp_path: Path) -> Callable[..., Plan]:
    """A function that makes a bag with one message per topic and plans its replay."""

    def plan(topics: dict[str, tuple], *, values: dict | None = None, **wishes: object) -> Plan:
        with BagWriter(tmp_path / "bag", overwrite=True) as bag:
            for topic, (kind, make) in topics.items():
                bag.add_topic(topic, kind)
                bag.write(topic, 10**9, make())
        with BagReader(tmp_path / "bag") as reader:
            return make_plan(reader, values or {}, Wishes(**wishes))

    return plan


def roles(plan: Plan) -> dict[str, str]:
    return {use.topic: use.used_as for use in plan.topics if use.used_as}


def test_a_usual_robot(plan_for) -> None:
    plan = plan_for({"/odom": ODOM, "/loops": CLOSURE, "/ground_truth/pose": ODOM, "/imu": GOOD_IMU, "/wind": WIND})
    assert roles(plan) == {
        "/odom": "odometry of robot",
        "/loops": "loop closures",
        "/ground_truth/pose": "reference for robot",
    }
    why = {use.topic: use.why_not for use in plan.topics if not use.used_as}
    assert why == {"/imu": "could be odometry: --odometry", "/wind": "neither odometry nor relative rotations"}
    assert plan.parameters.estimator.keyframe_source == "odometry"
    assert plan.parameters.odometry_topics == ("/odom:nav_msgs/msg/Odometry",)


def test_the_better_odometry_is_taken_and_an_imu_that_knows_nothing_is_not(plan_for) -> None:
    topics = {"/a/visual": ODOM, "/wheels/odom": ODOM, "/imu": BLIND_IMU}
    plan = plan_for(topics)
    assert roles(plan) == {"/wheels/odom": "odometry of robot"}
    assert {use.topic: use.why_not for use in plan.topics}[
        "/imu"
    ] == "none of its first 100 messages states an orientation"
    assert roles(plan_for({"/imu/data": GOOD_IMU})) == {"/imu/data": "odometry of robot"}


def test_who_brings_the_keyframes(plan_for) -> None:
    assert plan_for({"/odom": ODOM, "/edges": STEP}).parameters.estimator.keyframe_source == "edges"
    assert plan_for({"/odom": ODOM, "/edges": CLOSURE}).parameters.estimator.unknown_keyframes == "wait"
    assert plan_for({"/edges": CLOSURE}).parameters.estimator.unknown_keyframes == "create"
    told = plan_for({"/odom": ODOM, "/edges": STEP}, values={"keyframe_source": "odometry"})
    assert told.parameters.estimator.keyframe_source == "odometry"


def test_only_the_edges_that_are_used_bring_keyframes(plan_for) -> None:
    topics = {"/odom": ODOM, "/edges": STEP, "/loops": CLOSURE}
    assert plan_for(topics, edges=["/loops"]).parameters.estimator.keyframe_source == "odometry"
    assert plan_for(topics, edges=["/edges"]).parameters.estimator.keyframe_source == "edges"


def test_several_robots(plan_for) -> None:
    topics = {"/red/odom": ODOM, "/blue/odom": ODOM, "/truth": ODOM, "/blue/gt": ODOM}
    plan = plan_for(topics, odometry=["/red/odom", "blue/odom"], references=["/truth", "/blue/gt"])
    assert plan.parameters.robots == ("red", "blue")
    assert roles(plan) == {
        "/red/odom": "odometry of red",
        "/blue/odom": "odometry of blue",
        "/truth": "reference for red",
        "/blue/gt": "reference for blue",
    }
    named = plan_for(topics, odometry=["/red/odom", "/blue/odom"], robots=["r", "b"])
    assert named.parameters.robots == ("r", "b")


def test_closures_are_of_the_robot_in_whose_namespace_they_are(plan_for) -> None:
    topics = {"/a/odom": ODOM, "/b/odom": ODOM, "/between": CLOSURE, "/a/loops": CLOSURE, "/b/loops": CLOSURE}
    both = ["/b/odom", "/a/odom"]
    plan = plan_for(topics, odometry=both, robots=["blue", "amber"])
    assert roles(plan) == {
        "/a/odom": "odometry of amber",
        "/b/odom": "odometry of blue",
        "/between": "loop closures",
        "/a/loops": "loop closures of amber",
        "/b/loops": "loop closures of blue",
    }
    assert [source.robot for source in plan.parameters.edge_sources()] == ["amber", "blue", "blue"]
    told = plan_for(topics, odometry=both, values={"edge_robots": ("a", "b", "a")})
    assert told.parameters.edge_robots == ("a", "b", "a")
    listed = plan_for(topics, odometry=both, values={"edge_topics": ("/a/loops", "/b/loops")})
    assert listed.parameters.edge_robots == ("",)  # as a node with these parameters has it


def test_closures_of_a_robot_whose_odometry_is_not_used_are_left_out(plan_for) -> None:
    topics = {"/a/odom": ODOM, "/b/odom": ODOM, "/between": CLOSURE, "/a/loops": CLOSURE, "/b/loops": CLOSURE}
    plan = plan_for(topics)
    assert roles(plan) == {"/a/odom": "odometry of robot", "/between": "loop closures", "/a/loops": "loop closures"}
    why = {use.topic: use.why_not for use in plan.topics}["/b/loops"]
    assert why == "loop closures of another robot, by its namespace: --odometry, --edges"
    assert set(roles(plan_for(topics, odometry=["/b/odom"]))) == {"/b/odom", "/between", "/b/loops"}
    assert "/b/loops" in roles(plan_for(topics, edges=["/b/loops"]))
    sensor = {"/wheels/odom": ODOM, "/camera/visual": ODOM, "/camera/loops": CLOSURE}
    assert "/camera/loops" in roles(plan_for(sensor))
    sensor = {"/robot/odom": ODOM, "/robot/loops": CLOSURE, "/camera/imu": GOOD_IMU, "/camera/loops": CLOSURE}
    assert "/camera/loops" in roles(plan_for(sensor))


def test_options_win_over_parameters_and_these_over_guesses(plan_for) -> None:
    topics = {"/odom": ODOM, "/visual": ODOM, "/imu": GOOD_IMU}
    values = {"odometry_topics": ("visual",)}
    assert roles(plan_for(topics, values=values))["/visual"] == "odometry of robot"
    assert roles(plan_for(topics, values=values, odometry=["/imu"]))["/imu"] == "odometry of robot"
    assert "/imu" not in roles(plan_for(topics, references=["none"]))


def test_a_node_listens_to_more_than_was_recorded(plan_for) -> None:
    """Its parameters for topics that are not there go with them; options have to be right."""
    everything = NodeParameters().values()
    assert roles(plan_for({"/wheels": ODOM, "/relative_rotations": CLOSURE}, values=everything)) == {
        "/wheels": "odometry of robot",
        "/relative_rotations": "loop closures",
    }
    turned = (0.0, 0.0, 1.0, 0.0)
    values = {
        "edge_topics": ("laser", "camera"),
        "edge_robots": ("red", "blue"),
        "edge_sensor_orientations": (*IDENTITY.tolist(), *turned),
        "robots": ("red", "blue"),
        "odometry_topics": ("red/odom", "blue/odom"),
    }
    plan = plan_for({"/blue/odom": ODOM, "/camera": CLOSURE, "/blue/gt": ODOM}, values=values)
    (source,) = plan.parameters.edge_sources()
    assert (source.robot, source.body_from_sensor) == ("blue", turned)
    assert roles(plan)["/blue/odom"] == "odometry of blue" and roles(plan)["/blue/gt"] == "reference for blue"


@pytest.mark.parametrize("recorded", [["/red/odom", "/blue/odom"], ["/blue/odom"], []])
def test_robots_keep_their_numbers_where_their_odometry_was_not_recorded(plan_for, recorded: list[str]) -> None:
    """Messages number them, and edges that name none are the first one's: as in the node."""
    turned = (0.0, 0.0, 1.0, 0.0)
    values = {
        "robots": ("red", "blue"),
        "odometry_topics": ("red/odom", "blue/odom"),
        "odometry_sensor_orientations": (*IDENTITY.tolist(), *turned),
        "keyframe_source": "edges",
    }
    plan = plan_for(dict.fromkeys(recorded, ODOM) | {"/edges": STEP, "/imu": GOOD_IMU}, values=values)
    assert plan.parameters.robots == ("red", "blue")
    (source,) = plan.parameters.edge_sources()
    assert (source.robot, source.robot_of(0), source.robot_of(1)) == ("red", "red", "blue")
    sensors = {"red": tuple(IDENTITY), "blue": turned}
    odometry = plan.odometry_of_robots()
    assert [(source.topic, sensor) for _, source, sensor in odometry] == [
        (topic, sensors[topic.split("/")[1]]) for topic in recorded
    ]


def test_robots_can_be_named_without_any_odometry(plan_for) -> None:
    plan = plan_for({"/edges": STEP}, robots=["red", "blue"])
    assert plan.parameters.robots == ("red", "blue") and plan.odometry_of_robots() == []
    named = plan_for({"/edges": STEP, "/imu": GOOD_IMU}, robots=["red", "blue"], odometry=["none"])
    assert named.parameters.robots == ("red", "blue") and named.odometry_of_robots() == []
    one = plan_for({"/odom": ODOM}, values={"robots": ("rover",), "odometry_topics": ("wheels",)})
    assert roles(one) == {"/odom": "odometry of rover"}


def test_the_nodes_own_parameter_file(tmp_path: Path) -> None:
    path = tmp_path / "node.yaml"
    wanted = NodeParameters().changed({"keyframe_angle_deg": 7.0, "robots": ("rover",)})
    path.write_text(to_yaml(wanted))
    values, notes = read_parameter_file(path)
    assert notes == [] and NodeParameters().changed(values) == wanted
    path.write_text("/**:\n  ros__parameters:\n    keyframe_angle_deg: 7\n    qos_overrides./odom.depth: 5\n")
    assert read_parameter_file(path) == ({"keyframe_angle_deg": 7.0}, [])
    path.write_text("/other:\n  ros__parameters:\n    keyframe_angle_deg: 7\n")
    with pytest.raises(ReplayOptionError, match="has no parameters of the node"):
        read_parameter_file(path)
    path.write_text("a: [")
    with pytest.raises(ReplayOptionError, match="is not YAML"):
        read_parameter_file(path)


@pytest.mark.parametrize(
    "content",
    [
        "/rotavg: &here\n  below: *here\n",
        "/rotavg:\n  ros__parameters: &here\n    below: *here\n",
        f"/rotavg:\n  ros__parameters:\n    robots: {'[' * 5000}{']' * 5000}\n",
    ],
)
def test_a_file_without_an_end_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(content)
    with pytest.raises(ReplayOptionError, match=rf"{path}: is nested too deeply, or refers to itself"):
        read_parameter_file(path)
    with pytest.raises(ReplayOptionError, match="it must be a list of texts"):
        read_settings([f"robots:={'[' * 5000}{']' * 5000}"])


PARAMETERS = "  ros__parameters:\n    max_keyframes: 100\n"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            f"/rotavg:\n{PARAMETERS}    gauge: odometry\n    max_keyframes: 200\n",
            ":5: max_keyframes is there already in ",
        ),
        (
            f"/**:\n{PARAMETERS}    max_keyframes: 100\n",
            ":4: max_keyframes is there already in line 3; leave one of them",
        ),
        (f"/a/rotavg:\n{PARAMETERS}{PARAMETERS}", ":4: ros__parameters is there already in line 2"),
        (f"/rotavg:\n{PARAMETERS}/rotavg:\n{PARAMETERS}", ":4: /rotavg is there already in line 1"),
        (f"/rotavg:\n{PARAMETERS}/other:\n{PARAMETERS}    max_keyframes: 200\n", None),
        (f"/rotavg:\n{PARAMETERS}/**:\n{PARAMETERS}", None),
        (f"x: &x {{max_keyframes: 7}}\n/rotavg:\n{PARAMETERS}    <<: *x\n", None),
    ],
)
def test_a_parameter_that_is_there_twice_is_refused(tmp_path: Path, content: str, told: str | None) -> None:
    """ROS takes the last and says nothing. What stands twice in another node's part is that node's matter."""
    path = tmp_path / "node.yaml"
    path.write_text(content)
    if told is None:
        assert read_parameter_file(path) == ({"max_keyframes": 100}, [])
        return
    with pytest.raises(ReplayOptionError) as caught:
        read_parameter_file(path)
    assert str(caught.value).startswith(f"{path}{told}") and "\n" not in str(caught.value)


ANGLE = {"keyframe_angle_deg": 7.0}


@pytest.mark.parametrize(
    ("content", "notes"),
    [
        ({"/rotavg": {"ros__parameters": ANGLE | {"use_sim_time": True, "start_type_description_service": False}}}, []),
        ({"/robot1": {"rotavg": {"ros__parameters": ANGLE}}, "/robot1/slam": {"ros__parameters": {"x": 1}}}, []),
        ({"/**": {"ros__parameters": {"qos_overrides": {"/odom": {"subscription": {"depth": 5}}}, **ANGLE}}}, []),
        (
            {"/**": {"ros__parameters": ANGLE | {"max_velocity": 3.0, "planner": {"rate": 1}}}},
            ["unknown parameter max_velocity is ignored", "unknown parameter planner.rate is ignored"],
        ),
        (
            {"/**": {"ros__parameters": {"keyframe_angel_deg": 1.0}}, "rotavg": {"ros__parameters": ANGLE}},
            ["unknown parameter keyframe_angel_deg is ignored; did you mean keyframe_angle_deg?"],
        ),
    ],
    ids=["rclpy's own", "nested", "nested qos", "others", "a slip of the pen"],
)
def test_what_the_node_takes_is_taken(tmp_path: Path, content: dict, notes: list[str]) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    values, said = read_parameter_file(path)
    assert {name: values[name] for name in values if name not in ("odometry_topics", "edge_topics")} == ANGLE
    assert said == [f"{path}: {note}" for note in notes]


@pytest.mark.parametrize(
    ("name", "stated", "odometry"),
    [
        ("/blue/rotavg", {}, "/blue/odom"),
        ("/blue/rotavg", {"odometry_topics": ["wheels"]}, "/blue/wheels"),
        ("/blue/rotavg", {"odometry_topics": ["/red/odom"]}, "/red/odom"),
        ("/fleet/red/rotavg", {}, "/blue/odom"),  # the bag has nothing of it, so it is guessed
        ("/**/rotavg", {}, "/blue/odom"),
        ("/rotavg", {"odometry_topics": ["blue/odom"]}, "/blue/odom"),
    ],
)
def test_topics_are_those_of_the_nodes_namespace(
    plan_for, tmp_path: Path, name: str, stated: dict[str, list[str]], odometry: str
) -> None:
    (tmp_path / "node.yaml").write_text(yaml.safe_dump({name: {"ros__parameters": ANGLE | stated}}))
    values, _ = read_parameter_file(tmp_path / "node.yaml")
    topics = {"/red/odom": ODOM, "/blue/odom": ODOM, "/blue/wheels": ODOM}
    topics |= {"/red/relative_rotations": CLOSURE, "/blue/relative_rotations": CLOSURE}
    plan = plan_for(topics, values=values)
    assert [source.topic for source in plan.odometry] == [odometry]
    assert [source.topic for source in plan.edges] == ["/blue/relative_rotations"]


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("keyframe_angle_deg", "1e1", 10.0),
        ("keyframe_angle_deg", ".5E1", 5.0),
        ("keyframe_angle_deg", "08", 8.0),
        ("max_keyframes", "010", 8),
        ("world_frame", "2024-13-45", "2024-13-45"),
        ("world_frame", "2024-01-31", "2024-01-31"),
        ("robots", "[1:30, 1_000]", ("1:30", "1_000")),
    ],
)
def test_numbers_are_those_that_are_numbers_to_the_node(tmp_path: Path, name: str, text: str, value: object) -> None:
    (tmp_path / "node.yaml").write_text(f"/rotavg:\n  ros__parameters:\n    {name}: {text}\n")
    for values in (read_settings([f"{name}:={text}"]), read_parameter_file(tmp_path / "node.yaml")[0]):
        assert values == {name: value} and type(values[name]) is type(value)


def test_a_file_of_two_nodes_is_not_mixed(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text(yaml.safe_dump({robot: {"rotavg": {"ros__parameters": ANGLE}} for robot in ("red", "blue")}))
    with pytest.raises(ReplayOptionError, match=r"several nodes \(/blue/rotavg, /red/rotavg\)"):
        read_parameter_file(path)


def test_what_only_a_running_node_has_is_left_out(plan_for) -> None:
    topics = {"/imu": GOOD_IMU, "/relative_rotations": CLOSURE}
    values = {"edge_topics": ("relative_rotations",), "forward_topics": ("relative_rotations:good",)}
    values |= {"publish_tf": True, "autosave_period_s": 5.0, "solver_process": True}
    plan = plan_for(topics, values=values)
    assert roles(plan)["/relative_rotations"] == "loop closures"
    assert plan.unused == ("forward_topics", "publish_tf", "autosave_period_s")
