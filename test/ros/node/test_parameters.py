"""Parameters: one dataclass, and everything that is made from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields

import pytest
import yaml

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.parameter import Parameter

from rotavg_ros.ros.node import parameter_server
from rotavg_ros.settings.fields import ParameterError
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.settings.text import to_markdown, to_yaml


@pytest.fixture
def make_node() -> Iterator[Callable[..., rclpy.node.Node]]:
    """A function that makes a node that was started with some parameters."""
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = []

    def make(**overrides: object) -> rclpy.node.Node:
        parameters = [Parameter(name, value=value) for name, value in overrides.items()]
        nodes.append(rclpy.create_node("parameters", context=context, parameter_overrides=parameters))
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_the_defaults_are_good_and_declared_with_descriptions_and_ranges(make_node) -> None:
    node = make_node()
    assert parameter_server.declare(node) == NodeParameters()
    for parameter in fields(NodeParameters):
        descriptor = node.describe_parameter(parameter.name)
        assert descriptor.description
        assert descriptor.read_only != parameter.metadata["live"]
    assert node.describe_parameter("outlier_threshold").floating_point_range[0].to_value == 1.0
    assert node.describe_parameter("refinement_steps").integer_range[0].from_value == -1


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"keyframe_angle_deg": "5"}, "keyframe_angle_deg has the wrong type; it must be double"),
        ({"keyframe_angle_deg": 500}, "keyframe_angle_deg must be between 0 and 360"),
        ({"world_frame": ""}, "world_frame is ''; name the frame"),
        ({"world_frame": "/map"}, "world_frame is '/map'; name the frame"),
        ({"publish_tf": True, "odometry_topics": ["imu:sensor_msgs/msg/Imu"]}, "imu:sensor_msgs/msg/Imu has none"),
        ({"odometry_topics": None}, "odometry_topics is empty"),
        ({"robots": "a"}, "robots has the wrong type; it must be string array"),
        ({"pending_capacity": 0}, "pending_capacity must be between 1 and"),
        ({"outlier_threshold": 1.5}, "outlier_threshold must be between 0 and 1"),
        ({"keyframe_angle_deg": float("nan")}, "keyframe_angle_deg"),
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
    ],
)
def test_mistakes_are_one_clear_line(make_node, overrides: dict[str, object], message: str) -> None:
    with pytest.raises(ParameterError, match=message) as refusal:
        parameter_server.declare(make_node(**overrides))
    assert "\n" not in str(refusal.value)


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
    assert (found.keyframe_angle_deg, found.edge_sensor_orientations) == (5.0, (0.0, 0.0, 0.0, 1.0))
    now = [found]
    parameter_server.watch(node, lambda: now[0], lambda parameters: now.__setitem__(0, parameters))
    (result,) = node.set_parameters([Parameter("keyframe_angle_deg", value=7)])
    assert result.successful and now[0].keyframe_angle_deg == 7.0
    assert node.get_parameter("keyframe_angle_deg").value == 7.0


def test_the_yaml_is_what_a_node_reads(make_node) -> None:
    parameters = NodeParameters().changed({"robots": ["a"], "gauge": "identity", "solve_period_s": 2.0})
    loaded = yaml.safe_load(to_yaml(parameters, "/fleet/rotavg"))["/fleet/rotavg"]["ros__parameters"]
    assert parameter_server.declare(make_node(**loaded)) == parameters


def test_the_table_names_every_parameter() -> None:
    table = to_markdown()
    assert all(f"| `{parameter.name}` |" in table for parameter in fields(NodeParameters))
    assert len(table.splitlines()) == 2 + len(fields(NodeParameters))
