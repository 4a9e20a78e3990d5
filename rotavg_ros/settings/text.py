"""The parameters as text: a YAML file for the node, and the README's table."""

from __future__ import annotations

from typing import Any

from rotavg_ros.settings.parameters import NODE_NAME, PARAMETERS, NodeParameters

# Parameters that change something by being stated, whatever their value, and what to say of them.
_MEANT_IF_STATED = {
    "edge_sensor_orientations": "where it is stated, even as it is by default, /tf_static is not used for edges"
}


def to_yaml(parameters: NodeParameters, node_name: str = f"/{NODE_NAME}") -> str:
    """A parameter file for ``--params-file``, every parameter with its description.

    Those that mean something by being stated are comments where they have their defaults.
    """
    lines = [f"{node_name}:", "  ros__parameters:"]
    for name, value in parameters.values().items():
        lines.append(f"    # {PARAMETERS[name].description}")
        is_unsaid = name in _MEANT_IF_STATED and value == PARAMETERS[name].default
        lines += [f"    # {_MEANT_IF_STATED[name]}"] if is_unsaid else []
        lines.append(f"    {'# ' * is_unsaid}{name}: {_yaml(value)}")
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
