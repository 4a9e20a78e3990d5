"""The node's parameters come from one description: the estimator's options, the YAML, the table."""

from __future__ import annotations

import pydoc
import re
from pathlib import Path

import pytest
import yaml

from rotavg_ros import EstimatorOptions, UserError
from rotavg_ros.option import OptionError, options_of
from rotavg_ros.settings.parameters import PARAMETERS, NodeParameters
from rotavg_ros.settings.text import to_markdown, to_yaml


def table() -> dict[str, list[str]]:
    rows = [line.split(" | ") for line in to_markdown().splitlines()[2:]]
    return {row[0].strip("|` "): [cell.strip(" |") for cell in row[1:]] for row in rows}


@pytest.mark.parametrize("option", options_of(EstimatorOptions), ids=lambda option: option.name)
def test_every_option_of_the_estimator_is_a_parameter_of_the_node(option) -> None:
    assert PARAMETERS[option.name] is option
    assert NodeParameters().values()[option.name] == option.default
    lines = to_yaml(NodeParameters()).splitlines()
    entry = next(index for index, line in enumerate(lines) if line.startswith(f"    {option.name}: "))
    assert yaml.safe_load(lines[entry]) == {option.name: option.default}
    assert lines[entry - 1] == f"    # {option.description}"
    default, allowed, live, description = table()[option.name]
    assert yaml.safe_load(default.strip("`")) == option.default
    assert allowed == (option.range or " ".join(f"`{choice}`" for choice in option.choices))
    assert (live, description) == ("yes" if option.live else "", option.description)


def test_the_estimator_has_no_field_that_is_no_option() -> None:
    assert [each.field for each in options_of(EstimatorOptions)] == list(vars(EstimatorOptions()))


def test_help_tells_every_option_of_the_estimator() -> None:
    said = " ".join(pydoc.plain(pydoc.render_doc(EstimatorOptions)).replace("|", " ").split())
    for each in options_of(EstimatorOptions):
        assert f" {each.field}: {each.description} (" in said


def test_the_table_and_the_yaml_name_every_parameter_once() -> None:
    assert list(table()) == list(PARAMETERS) == list(NodeParameters().values())
    ours = yaml.safe_load(to_yaml(NodeParameters()))["/rotavg"]["ros__parameters"]
    assert list(ours) == list(PARAMETERS)


def test_transforms_are_in_use_until_an_orientation_is_stated() -> None:
    """Also with all defaults stated, as `ros2 param dump` writes them; those of edges had ruled transforms out."""
    stated = NodeParameters().changed(NodeParameters().values())
    assert stated == NodeParameters() and stated.places_edges_by_tf
    assert [source.body_from_sensor for source in stated.edge_sources()] == [(0.0, 0.0, 0.0, 1.0)] * 2
    assert not stated.changed({"edge_sensor_orientations": [0, 0, 0, 1]}).places_edges_by_tf
    assert not stated.changed({"edge_frames_from_tf": False}).places_edges_by_tf


def test_the_units_of_the_library_are_those_of_its_names() -> None:
    """By the numbers that the estimator has always begun with."""
    options = NodeParameters().estimator
    assert options == EstimatorOptions()
    assert (options.keyframe_angle, options.keyframe_distance) == (pytest.approx(0.0872664625997165), 0.5)
    assert (options.max_turn_rate, options.max_speed) == (pytest.approx(6.28318530717959), 50.0)
    changed = NodeParameters().changed({"keyframe_angle_deg": 180, "max_speed_m_s": 3, "refinement_steps": 0})
    assert changed.estimator.keyframe_angle == pytest.approx(3.14159265358979)
    assert (changed.estimator.max_speed, changed.estimator.for_solver["refinement_steps"]) == (3.0, 0)
    assert options.for_solver["refinement_steps"] is None and options.for_solver["weights"] is None
    assert NodeParameters().changed({"weights": "robot"}).estimator.for_solver["weights"] == Path("robot")


def test_a_path_may_begin_with_the_home_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As no shell puts it into a parameter file; ``state_file: ~/state`` made a folder of the name ``~`` necessary."""
    monkeypatch.setenv("HOME", str(tmp_path))
    homely = NodeParameters().changed({"state_file": "~/maps/state", "weights": "~/robot"})
    assert homely.state_path == tmp_path / "maps" / "state"
    assert homely.estimator.for_solver["weights"] == tmp_path / "robot"
    assert homely.values()["state_file"] == "~/maps/state"
    assert NodeParameters().changed({"state_file": "maps/~state"}).state_path == Path("maps/~state")
    assert NodeParameters().state_path is None


def test_a_change_keeps_the_rest_and_ignores_other_nodes_parameters() -> None:
    first = NodeParameters().changed({"gauge": "identity", "robots": ["a"], "use_sim_time": True})
    second = first.changed({"solve_period_s": 2})
    expected = NodeParameters().values() | {"gauge": "identity", "robots": ("a",), "solve_period_s": 2.0}
    assert second.values() == expected
    assert first.values() == expected | {"solve_period_s": 0.5}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keyframe_distance_m": -1}, "keyframe_distance_m is -1.0; it must be between 0 and 1e+06"),
        ({"gauge": "up"}, "gauge is 'up'; choose from odometry, identity"),
        ({"robots": ["a", "b"]}, "robots has 2 entries and odometry_topics 1; give one robot per topic"),
        (
            {"robots": ["1", "robot_1"], "odometry_topics": ["a", "b"]},
            "robots names '1' and 'robot_1', whose topics would both begin with robot_1/",
        ),
        ({"edge_topics": ["graph:rtabmap_msgs/msg/MapGraph"]}, "edge topic 'graph:rtabmap_msgs/msg/MapGraph' brings "),
        ({"edge_topics": ["closures:"]}, "edge_topics: 'closures:' lacks a topic or a type; write topic or topic:type"),
        ({"edge_topics": [":std_msgs/msg/String"]}, "edge_topics: ':std_msgs/msg/String' lacks a topic or a type"),
        ({"autosave_period_s": 5.0}, "autosave_period_s is set but state_file is empty; name a file"),
    ],
)
def test_parameters_that_cannot_be(changes: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=f"^{re.escape(message)}"):
        NodeParameters().changed(changes)


@pytest.mark.parametrize("kind", ["rtabmap_msgs/msg/MapGraph", "cslam_common_interfaces/msg/KeyframeOdom"])
def test_keyframes_of_two_robots_are_not_taken_for_one_robots(kind: str) -> None:
    """Both count from 0, and their messages name no robot."""
    values = {"edge_topics": [f"/a/graph:{kind}", f"/b/graph:{kind}"], "keyframe_source": "edges"}
    with pytest.raises(OptionError) as caught:
        NodeParameters().changed(values)
    told = "edge topics /a/graph and /b/graph both number keyframes of 'robot'; name the robot of each edge topic in "
    assert str(caught.value) == told + "edge_robots"
    fleet = {"robots": ["a", "b"], "odometry_topics": ["/a/odom", "/b/odom"]}
    named = NodeParameters().changed(values | fleet | {"edge_robots": ["", "b"]})
    assert [source.robot for source in named.edge_sources()] == ["a", "b"]


def test_several_topics_may_tell_of_a_robot() -> None:
    """Closures beside keyframes, and graphs that number their robots."""
    kinds = ["slam_toolbox/msg/NewNodeEvent", "slam_toolbox/msg/PoseGraph"]
    kinds += ["pose_graph_tools_msgs/msg/PoseGraph"] * 2 + ["cslam_common_interfaces/msg/InterRobotLoopClosure"] * 2
    topics = [f"/topic_{number}:{kind}" for number, kind in enumerate(kinds)]
    assert NodeParameters().changed({"edge_topics": topics, "keyframe_source": "edges"}).edge_topics == tuple(topics)
