"""The parameters as rclpy sees them: declared with ranges and descriptions, read, and watched for changes."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from rotavg_ros.errors import UserError
from rotavg_ros.settings.fields import ParameterError, default
from rotavg_ros.settings.parameters import NodeParameters

# How rclpy names the parameters that change a topic's quality of service.
_QOS = "qos_overrides"


def declare(node: Node) -> NodeParameters:
    """Declare all parameters on a node and read what it was started with.

    Raises:
        ParameterError: a value of the wrong type or outside its range, or values that do not fit together.
    """
    values = {}
    for parameter in fields(NodeParameters):
        try:
            declared = _declare(node, parameter.name, default(parameter), _descriptor(parameter.metadata))
        except (InvalidParameterTypeException, ParameterUninitializedException) as error:
            expected = Parameter.Type.from_parameter_value(default(parameter)).name.lower().replace("_", " ")
            raise ParameterError(f"parameter {parameter.name} has the wrong type; it must be {expected}") from error
        except InvalidParameterValueException as error:
            low, high = parameter.metadata["low"], parameter.metadata["high"]
            raise ParameterError(f"parameter {parameter.name} must be between {low:g} and {high:g}") from error
        if declared.value is None:  # what becomes of `-p name:=[]`
            raise ParameterError(f"parameter {parameter.name} is empty; give it a value or leave it out")
        values[parameter.name] = declared.value
    return NodeParameters().changed(values)


def given(node: Node) -> Mapping[str, Parameter]:
    """What a node was started with, by name, its own parameters and others."""
    overrides: Mapping[str, Parameter] = getattr(node, "_parameter_overrides", {})
    return overrides


def unknown(node: Node) -> tuple[list[str], list[str]]:
    """One line for every parameter the node was given that it does not have; to be asked once all topics are there.

    Returns:
        those that are surely meant for this node, and those that a file for many nodes may hold for another one.
    """
    qos = [f"{_QOS}.{name}" for name in node.get_parameters_by_prefix(_QOS)]
    ours = [*(parameter.name for parameter in fields(NodeParameters)), *qos]
    mistaken: list[str] = []
    others: list[str] = []
    for name in given(node):
        if not node.has_parameter(name):
            close = difflib.get_close_matches(name, ours, n=1)
            line = f"unknown parameter {name} is ignored" + (f"; did you mean {close[0]}?" if close else "")
            (mistaken if close or name.startswith(_QOS) else others).append(line)
    return mistaken, others


def _declare(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> Parameter:
    """Declare one; 5 is taken for 5.0 where a number with a fraction is wanted."""
    override = given(node).get(name)
    wanted = None if override is None else _as_wanted(override, value)
    if wanted is None or wanted is override:
        return node.declare_parameter(name, value, descriptor)
    return node.declare_parameter(name, wanted.value, descriptor, ignore_override=True)


def _as_wanted(parameter: Parameter, like: Any) -> Parameter:
    """Whole numbers as floating-point ones where ``like``, a good value, is one or a list of them."""
    if parameter.type_ is Parameter.Type.INTEGER and isinstance(like, float):
        return Parameter(parameter.name, value=float(parameter.value))
    if parameter.type_ is Parameter.Type.INTEGER_ARRAY and isinstance(like, list) and isinstance(like[0], float):
        return Parameter(parameter.name, value=[float(number) for number in parameter.value])
    return parameter


def watch(node: Node, current: Callable[[], NodeParameters], apply: Callable[[NodeParameters], None]) -> None:
    """Check every change as a set, together with what is not changed, and apply it if it is good."""

    def on_set(changes: list[Parameter]) -> SetParametersResult:
        try:
            apply(current().changed({change.name: change.value for change in changes}))
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def as_wanted(changes: list[Parameter]) -> list[Parameter]:
        defaults = {parameter.name: default(parameter) for parameter in fields(NodeParameters)}
        return [_as_wanted(change, defaults.get(change.name)) for change in changes]

    node.add_on_set_parameters_callback(on_set)
    if hasattr(node, "add_pre_set_parameters_callback"):  # not before Iron
        node.add_pre_set_parameters_callback(as_wanted)


def _descriptor(about: Any) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=about["description"], read_only=not about["live"])
    if about["choices"]:
        descriptor.additional_constraints = "one of " + ", ".join(about["choices"])
    low, high = about["low"], about["high"]
    if isinstance(low, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=float(high))]
    elif low is not None:
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor
