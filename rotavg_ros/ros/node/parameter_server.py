"""The node's parameters in rclpy: declared with ranges and descriptions, read, and watched for changes."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from rotavg_ros.errors import UserError
from rotavg_ros.option import Option, OptionError
from rotavg_ros.settings.parameter_file import repeated_parameter
from rotavg_ros.settings.parameters import NODE_NAME, PARAMETERS, NodeParameters

# Prefix of rclpy's parameters that change a topic's quality of service.
_QOS = "qos_overrides"


class ParameterNode(Node):
    """A node that refuses a parameter's value in the words of :mod:`rotavg_ros.option`, not in rclpy's."""

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """As rclpy's, which the services call; an integer such as 5 is accepted for a float parameter."""
        try:
            return super().set_parameters_atomically([_as_wanted(each) for each in parameter_list])
        except OptionError as error:
            return SetParametersResult(successful=False, reason=str(error))


def refuse_repeated(node: Node, arguments: Sequence[str]) -> None:
    """Refuse a parameter that stands twice in one of the files that a process was started with: ROS takes the last.

    Args:
        node: whose parameters count; others' are theirs.
        arguments: the process's.

    Raises:
        UserError: there is one.
    """
    for flag, file in pairwise(arguments):
        if flag != "--params-file":
            continue
        try:
            text = Path(file).read_text(encoding="utf-8")
            line = repeated_parameter(Path(file), text, NODE_NAME, node.get_name())
        except (OSError, ValueError, yaml.YAMLError, RecursionError):
            continue  # whatever rclpy has read of it counts
        if line is not None:
            raise UserError(line)


def declare(node: Node) -> NodeParameters:
    """Declare all parameters on a node and read what it was started with.

    Raises:
        OptionError: a value of the wrong type or outside its range, or values that do not fit together.
    """
    started_with, values = given(node), {}
    for name, option in PARAMETERS.items():
        parameter = _as_wanted(started_with.get(name) or Parameter(name, value=_for_ros(option.default)))
        if parameter.type_ is Parameter.Type.NOT_SET:  # as after `-p name:=[]`
            raise OptionError(f"parameter {name} is empty; give it a value or leave it out")
        node.declare_parameter(name, parameter.value, _descriptor(option), ignore_override=True)
        values[name] = parameter.value
    return NodeParameters().changed(values)


def given(node: Node) -> Mapping[str, Parameter]:
    """Parameters that a node was started with, by name: its own and others."""
    overrides: Mapping[str, Parameter] = getattr(node, "_parameter_overrides", {})
    return overrides


def unknown(node: Node) -> tuple[list[str], list[str]]:
    """One line for every given parameter that the node does not have; call it once all topics exist.

    Returns:
        lines about those that are certainly meant for this node, and about those that may be meant for another.
    """
    qos = [f"{_QOS}.{name}" for name in node.get_parameters_by_prefix(_QOS)]
    ours = [*PARAMETERS, *qos]
    mistaken: list[str] = []
    others: list[str] = []
    for name in given(node):
        if not node.has_parameter(name):
            close = difflib.get_close_matches(name, ours, n=1)
            line = f"unknown parameter {name} is ignored" + (f"; did you mean {close[0]}?" if close else "")
            (mistaken if close or name.startswith(_QOS) else others).append(line)
    return mistaken, others


def _as_wanted(parameter: Parameter) -> Parameter:
    """One of our parameters with its value in the declared type; any other parameter unchanged.

    Raises:
        OptionError: an invalid value.
    """
    if parameter.name not in PARAMETERS or parameter.type_ is Parameter.Type.NOT_SET:
        return parameter
    return Parameter(parameter.name, value=_for_ros(PARAMETERS[parameter.name].checked(parameter.value)))


def _for_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def watch(node: Node, current: Callable[[], NodeParameters], apply: Callable[[NodeParameters], None]) -> None:
    """Check every set of changes, together with the unchanged parameters, and apply it if it is valid."""

    def on_set(changes: list[Parameter]) -> SetParametersResult:
        try:
            apply(current().changed({change.name: change.value for change in changes}))
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)


def _descriptor(option: Option) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=option.description, read_only=not option.live)
    if option.choices:
        descriptor.additional_constraints = "one of " + ", ".join(option.choices)
    if option.within:
        low, high = option.within
        if isinstance(option.default, int):
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor
