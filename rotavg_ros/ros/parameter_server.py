"""The parameters as rclpy sees them: declared with ranges and descriptions, read, and watched for changes."""

from __future__ import annotations

import difflib
from collections.abc import Callable
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


def declare(node: Node) -> NodeParameters:
    """Declare all parameters on a node and read what it was started with.

    Raises:
        ParameterError: a value of the wrong type or outside its range, or values that do not fit together.
    """
    values = {}
    for parameter in fields(NodeParameters):
        try:
            declared = node.declare_parameter(parameter.name, default(parameter), _descriptor(parameter.metadata))
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


def unknown(node: Node) -> list[str]:
    """One line for every parameter the node was given that it does not have."""
    given = getattr(node, "_parameter_overrides", {})
    ours = [parameter.name for parameter in fields(NodeParameters)]
    lines = []
    for name in given:
        if node.has_parameter(name) or name.startswith("qos_overrides."):
            continue
        close = difflib.get_close_matches(name, ours, n=1)
        lines.append(f"unknown parameter {name} is ignored" + (f"; did you mean {close[0]}?" if close else ""))
    return lines


def watch(node: Node, current: Callable[[], NodeParameters], apply: Callable[[NodeParameters], None]) -> None:
    """Check every change as a set, together with what is not changed, and apply it if it is good."""

    def on_set(changes: list[Parameter]) -> SetParametersResult:
        try:
            apply(current().changed({change.name: change.value for change in changes}))
        except UserError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)


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
