"""The parameters as text: a YAML file for the node, and the README's table."""

from __future__ import annotations

from typing import Any

from rotavg_ros.settings.parameters import NODE_NAME, PARAMETERS, NodeParameters


def to_yaml(parameters: NodeParameters, node_name: str = f"/{NODE_NAME}") -> str:
    """A parameter file for ``--params-file``, every parameter with its description."""
    lines = [f"{node_name}:", "  ros__parameters:"]
    for name, value in parameters.values().items():
        lines.append(f"    # {PARAMETERS[name].description}")
        lines.append(f"    {name}: {_yaml(value)}")
    return "\n".join(lines) + "\n"


def to_markdown() -> str:
    """The README's table."""
    lines = ["| parameter | default | range | live | |", "|---|---|---|---|---|"]
    for name, about in PARAMETERS.items():
        allowed = " ".join(f"`{choice}`" for choice in about.choices) or about.range
        live = "yes" if about.live else ""
        lines.append(f"| `{name}` | `{_yaml(about.default)}` | {allowed} | {live} | {about.description} |")
    return "\n".join(lines) + "\n"


def _yaml(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_yaml(entry) for entry in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)
