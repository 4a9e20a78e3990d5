"""A parameter as a dataclass field: its default, what it means, and what it may be."""

from __future__ import annotations

from dataclasses import MISSING, Field, field
from typing import Any

from rotavg_ros.errors import UserError


class ParameterError(UserError):
    """Parameters that cannot be, alone or together."""


def parameter(
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """A field; ``live``: it can be changed while the node runs."""
    metadata = {"description": description, "low": low, "high": high, "choices": choices, "live": live}
    return field(default=default, metadata=metadata)


def default(parameter: Field[Any]) -> Any:
    """A field's default, with lists for tuples, as rclpy and YAML want them."""
    assert parameter.default is not MISSING
    return list(parameter.default) if isinstance(parameter.default, tuple) else parameter.default


def check(parameter: Field[Any], value: Any) -> None:
    """Refuse a value that the parameter cannot have.

    Raises:
        ParameterError: it is none of the choices, or out of range.
    """
    about, name = parameter.metadata, parameter.name
    if about["choices"] and value not in about["choices"]:
        raise ParameterError(f"{name} is {value!r}; choose from {', '.join(about['choices'])}")
    if about["low"] is not None and not about["low"] <= value <= about["high"]:
        raise ParameterError(f"{name} is {value}; it must be between {about['low']:g} and {about['high']:g}")
