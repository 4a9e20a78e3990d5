"""The parameters as text: a YAML file for the node, and the README's table."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from rotavg_ros.settings.fields import default
from rotavg_ros.settings.parameters import NODE_NAME, NodeParameters


def to_yaml(parameters: NodeParameters, node_name: str = f"/{NODE_NAME}") -> str:
    """A parameter file for ``--params-file``, every parameter with its description."""
    lines = [f"{node_name}:", "  ros__parameters:"]
    for parameter in fields(parameters):
        value = getattr(parameters, parameter.name)
        lines.append(f"    # {parameter.metadata['description']}")
        lines.append(f"    {parameter.name}: {_yaml(list(value) if isinstance(value, tuple) else value)}")
    return "\n".join(lines) + "\n"


def to_markdown() -> str:
    """The README's table."""
    lines = ["| parameter | default | range | live | |", "|---|---|---|---|---|"]
    for parameter in fields(NodeParameters):
        about = parameter.metadata
        allowed = " ".join(f"`{choice}`" for choice in about["choices"])
        if about["low"] is not None:
            allowed = f"{about['low']:g} … {about['high']:g}"
        live = "yes" if about["live"] else ""
        name, value = parameter.name, _yaml(default(parameter))
        lines.append(f"| `{name}` | `{value}` | {allowed} | {live} | {about['description']} |")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    if isinstance(value, list):
        return "[" + ", ".join(_yaml(entry) for entry in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)
