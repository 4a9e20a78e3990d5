"""Parameters as ROS declares, reads and changes them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import yaml

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.parameter import Parameter

from rotavg_ros import EstimatorOptions
from rotavg_ros.errors import UserError
from rotavg_ros.option import OptionError
from rotavg_ros.replay.options import ReplayOptionError, read_parameter_file, read_settings
from rotavg_ros.ros.node import parameter_server
from rotavg_ros.settings.parameters import PARAMETERS, NodeParameters
from rotavg_ros.settings.text import to_yaml


@pytest.fixture
def make_node() -> Iterator[Callable[..., parameter_server.ParameterNode]]:
    """A function that makes a node that was started with some parameters."""
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = []

    def make(**overrides: object) -> parameter_server.ParameterNode:
        parameters = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(parameter_server.ParameterNode("parameters", context=context, parameter_overrides=parameters))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_the_defaults_are_good_and_declared_with_descriptions_and_ranges(make_node) -> None:
    node = make_node()
    assert parameter_server.declare(node) == NodeParameters()
    for name, option in PARAMETERS.items():
        descriptor = node.describe_parameter(name)
        assert descriptor.description == option.description
        assert descriptor.read_only != option.live
    assert node.describe_parameter("outlier_threshold").floating_point_range[0].to_value == 1.0
    assert node.describe_parameter("refinement_steps").integer_range[0].from_value == -1


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"keyframe_angle_deg": "5"}, "keyframe_angle_deg is '5'; it must be a number"),
        ({"keyframe_angle_deg": 500}, r"keyframe_angle_deg is 500\.0; it must be between 0 and 360"),
        ({"world_frame": ""}, "world_frame is ''; name the frame"),
        ({"world_frame": "/map"}, "world_frame is '/map'; name the frame"),
        ({"publish_tf": True, "odometry_topics": ["imu:sensor_msgs/msg/Imu"]}, "imu:sensor_msgs/msg/Imu has none"),
        ({"odometry_topics": None}, "odometry_topics is empty"),
        ({"robots": "a"}, "robots is 'a'; it must be a list of texts"),
        ({"pending_capacity": 0}, "pending_capacity is 0; it must be between 1 and"),
        ({"outlier_threshold": 1.5}, r"outlier_threshold is 1\.5; it must be between 0 and 1"),
        ({"keyframe_angle_deg": float("nan")}, "keyframe_angle_deg is nan; it must be between 0 and 360"),
        ({"gauge": "up"}, "choose from odometry, identity"),
        ({"device": "tpu"}, "choose from"),
        ({"robots": ["a", "b"]}, "one robot per topic"),
        ({"robots": ["a", "a"], "odometry_topics": ["x", "y"]}, "names something twice"),
        ({"edge_sensor_orientations": [0.0, 0.0, 1.0]}, "give 4, or 4 per edge topic"),
        ({"edge_sensor_orientations": [1.0, 1.0, 0.0, 0.0]}, "not of unit length"),
        ({"odometry_sensor_orientations": [0.0, 1.0]}, "give 4, or 4 per odometry topic"),
        ({"edge_robots": ["a", "b", "c"]}, "edge_robots has 3 entries; give 1, or one per edge topic"),
        ({"edge_topics": ["graph:rtabmap_msgs/msg/MapGraph"]}, "set keyframe_source to edges"),
        ({"autosave_period_s": 5.0}, "state_file is empty"),
        (
            {
                "edge_topics": ["keyframes:cslam_common_interfaces/msg/KeyframeOdom"],
                "keyframe_source": "edges",
                "forward_topics": ["keyframes:trusted"],
            },
            "keyframes is cslam_common_interfaces/msg/KeyframeOdom, which carries no closures",
        ),
    ],
)
def test_mistakes_are_one_clear_line(make_node, overrides: dict[str, object], message: str) -> None:
    with pytest.raises(OptionError, match=message) as refusal:
        parameter_server.declare(make_node(**overrides))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("node_name", "is_refused"), [("/fleet/rotavg", True), ("/**", True), ("/other", False)])
def test_a_parameter_that_is_there_twice_is_refused(make_node, tmp_path, node_name: str, is_refused: bool) -> None:
    path = tmp_path / "node.yaml"
    path.write_text(f"{node_name}:\n  ros__parameters:\n    gauge: identity\n    gauge: odometry\n")
    arguments = ["rotavg_node", "--ros-args", "--params-file", str(path), "--params-file", "missing.yaml"]
    told = pytest.raises(UserError, match=rf"^{path}:4: gauge is there already in line 3")
    with told if is_refused else nullcontext():
        parameter_server.refuse_repeated(make_node(), arguments)


def test_unknown_parameters_are_named_with_a_suggestion(make_node) -> None:
    node = make_node(keyframe_angel_deg=3.0, planner_frequency=1, **{"qos_overrides./odom.subscription.depth": 5})
    parameter_server.declare(node)
    mistaken, others = parameter_server.unknown(node)
    assert mistaken == [
        "unknown parameter keyframe_angel_deg is ignored; did you mean keyframe_angle_deg?",
        "unknown parameter qos_overrides./odom.subscription.depth is ignored",
    ]
    assert others == ["unknown parameter planner_frequency is ignored"]


def test_whole_numbers_are_taken_where_fractions_may_be(make_node) -> None:
    node = make_node(keyframe_angle_deg=5, edge_sensor_orientations=[0, 0, 0, 1])
    found = parameter_server.declare(node)
    assert (found.values()["keyframe_angle_deg"], found.edge_sensor_orientations) == (5.0, (0.0, 0.0, 0.0, 1.0))
    now = [found]
    parameter_server.watch(node, lambda: now[0], lambda parameters: now.__setitem__(0, parameters))
    result = node.set_parameters_atomically([Parameter("keyframe_angle_deg", value=7)])
    assert result.successful and now[0].values()["keyframe_angle_deg"] == 7.0
    assert node.get_parameter("keyframe_angle_deg").value == 7.0


def test_the_yaml_is_what_a_node_reads(make_node) -> None:
    parameters = NodeParameters().changed({"robots": ["a"], "gauge": "identity", "solve_period_s": 2.0})
    loaded = yaml.safe_load(to_yaml(parameters, "/fleet/rotavg"))["/fleet/rotavg"]["ros__parameters"]
    assert parameter_server.declare(make_node(**loaded)) == parameters


@pytest.mark.parametrize(
    ("name", "value", "in_library"),
    [
        ("keyframe_angle_deg", 500.0, {"keyframe_angle": math.radians(500)}),
        ("keyframe_distance_m", -1.5, {"keyframe_distance": -1.5}),
        ("max_turn_rate_deg_s", 2e6, {"max_turn_rate": math.radians(2e6)}),
        ("max_keyframes", 0, {"max_keyframes": 0}),
        ("refinement_steps", -2, {"refinement_steps": -2}),
        ("outlier_threshold", 1.5, {"outlier_threshold": 1.5}),
        ("outlier_threshold", "high", {"outlier_threshold": "high"}),
        ("on_time_jump", "faint", {"on_time_jump": "faint"}),
        ("profile", "slow", {"profile": "slow"}),
        ("warm_start", 1, {"warm_start": 1}),
    ],
)
def test_the_same_mistake_is_told_in_the_same_words_everywhere(
    make_node, tmp_path: Path, name: str, value: object, in_library: dict[str, Any]
) -> None:
    with pytest.raises(OptionError) as refusal:
        EstimatorOptions(**in_library)
    said = str(refusal.value)
    assert said.startswith(f"{name} is {value!r}; ")
    with pytest.raises(OptionError) as refusal:
        parameter_server.declare(make_node(**{name: value}))
    assert str(refusal.value) == said
    path = tmp_path / "node.yaml"
    path.write_text(yaml.safe_dump({"/rotavg": {"ros__parameters": {name: value}}}))
    with pytest.raises(ReplayOptionError) as refusal:
        read_parameter_file(path)
    assert str(refusal.value) == f"{path}: {said}"
    with pytest.raises(ReplayOptionError) as refusal:
        read_settings([f"{name}:={value}"])
    assert str(refusal.value) == f"-p: {said}"
    node = make_node()
    parameter_server.declare(node)
    result = node.set_parameters_atomically([Parameter(name, value=value)])
    assert (result.successful, result.reason) == (False, said)
