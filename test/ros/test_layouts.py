"""The ready-made RViz and Foxglove layouts show what the node really publishes."""

from __future__ import annotations

import importlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

pytestmark = pytest.mark.ros

RESOURCE = Path(__file__).parents[2] / "resource"
RVIZ_TYPES = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
}


def panels_of(layout: str | dict[str, Any]) -> Iterator[str]:
    """The panels in a Foxglove layout's tree of splits."""
    if isinstance(layout, str):
        yield layout
    else:
        assert layout["direction"] in ("row", "column")
        yield from panels_of(layout["first"])
        yield from panels_of(layout["second"])


def fields_of(type_name: str) -> dict[str, str]:
    """The fields of a message type, 'package/Type' or 'package/msg/Type', and their types."""
    package, *_, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name).get_fields_and_field_types()


def check_message_path(path: str, types: dict[str, str], diagnostics: dict[str, str]) -> None:
    """Follow a Foxglove message path, `/topic.field[:]{key=="…"}.field`, through the types of the fields."""
    topic, *steps = path.split(".")
    kind = types[topic]
    for step in steps:
        name, sliced, key, value = re.fullmatch(r'(\w+)(\[:\])?(?:\{(\w+)=="(.*)"\})?', step).groups()
        kind = fields_of(kind)[name]
        kind = re.fullmatch(r"sequence<(.*)>", kind)[1] if sliced else kind
        if key is not None:
            assert key in fields_of(kind)
            assert value == diagnostics["name"] if key == "name" else value in diagnostics
    assert kind in ("float", "double", "string"), f"{path} ends in {kind}, which cannot be plotted"


def test_rviz_and_foxglove_find_what_they_look_for(live_node) -> None:
    live_node.start()
    types = {topic: kind for topic, (kind, *_) in live_node.probe.get_topic_names_and_types()}
    rviz = yaml.safe_load((RESOURCE / "rotavg.rviz").read_text())["Visualization Manager"]
    displays = [display for display in rviz["Displays"] if "Topic" in display]
    assert {display["Class"] for display in displays} == set(RVIZ_TYPES)
    assert rviz["Global Options"]["Fixed Frame"] == "map"
    for display in displays:
        topic = display["Topic"]
        assert types[topic["Value"]] == RVIZ_TYPES[display["Class"]]
        latched = topic["Durability Policy"] == "Transient Local"
        for info in live_node.probe.get_publishers_info_by_topic(topic["Value"]):
            assert latched == (info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)
            assert topic["Reliability Policy"] == "Best Effort" or (
                info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
            )

    foxglove = json.loads((RESOURCE / "foxglove_layout.json").read_text())
    assert {"configById", "globalVariables", "layout", "playbackConfig", "userNodes"} == set(foxglove)
    panels = foxglove["configById"]
    assert sorted(panels_of(foxglove["layout"])) == sorted(panels)
    assert all(re.fullmatch(r"\w+!\w+", panel) for panel in panels)
    for panel, config in panels.items():
        kind = panel.split("!")[0]
        if kind == "3D":
            assert {types[topic] for topic in config["topics"]} == set(RVIZ_TYPES.values())
        elif kind == "DiagnosticSummary":
            assert types[config["topicToRender"]] == "diagnostic_msgs/msg/DiagnosticArray"
        else:
            assert kind == "Plot"
            for path in config["paths"]:
                check_message_path(path["value"], types, live_node.status)
