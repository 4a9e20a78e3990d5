"""The node's parameters for a replay: from its own YAML files and from words ``name:=value``."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from rotavg_ros.errors import UserError
from rotavg_ros.settings.parameters import NODE_NAME, NodeParameters

Values = dict[str, Any]

_DEFAULTS: dict[str, Any] = {parameter.name: parameter.default for parameter in fields(NodeParameters)}


class ReplayOptionError(UserError):
    """A parameter that the node does not have, or a value that it cannot have."""


def read_parameter_file(path: Path) -> Values:
    """What a file for ``--params-file`` says about the node; ``qos_overrides`` have no meaning here.

    Raises:
        ReplayOptionError: no such file, not YAML, or not a parameter file of the node.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayOptionError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except yaml.YAMLError as error:
        raise ReplayOptionError(f"{path}: is not YAML: {' '.join(str(error).split())}") from None
    nodes = content if isinstance(content, Mapping) else {}
    values: Values = {}
    for name, settings in nodes.items():
        if str(name).strip("/").split("/")[-1] in (NODE_NAME, "*", "**") and isinstance(settings, Mapping):
            values |= settings.get("ros__parameters") or {}
    if not values:
        raise ReplayOptionError(
            f"{path}: has no parameters of the node; expected '/{NODE_NAME}:' with 'ros__parameters:' below it, as "
            "`rotavg_node --print-parameters` writes it"
        )
    known = {name: value for name, value in values.items() if not name.startswith("qos_overrides")}
    return {name: _checked(name, value, str(path)) for name, value in known.items()}


def read_settings(words: Iterable[str]) -> Values:
    """Parameters from words ``name:=value``, the value in YAML, as after ``--ros-args -p``.

    Raises:
        ReplayOptionError: another form, an unknown name, or a value of the wrong type.
    """
    values: Values = {}
    for word in words:
        name, separator, text = word.partition(":=")
        if not separator:
            raise ReplayOptionError(f"-p {word}: write name:=value")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            value = text
        values[name] = _checked(name, value, "-p")
    return values


def _checked(name: str, value: Any, where: str) -> Any:
    """The value in its parameter's type."""
    if name not in _DEFAULTS:
        close = difflib.get_close_matches(name, list(_DEFAULTS), n=1)
        hint = f"did you mean {close[0]}?" if close else "see `rotavg_node --print-parameters`"
        raise ReplayOptionError(f"{where}: unknown parameter {name}; {hint}")
    default = _DEFAULTS[name]
    if isinstance(default, tuple):
        if isinstance(value, list) and all(_fits(entry, default[0]) for entry in value):
            return tuple(type(default[0])(entry) for entry in value)
        expected = f"list of {type(default[0]).__name__}"
    elif _fits(value, default):
        return type(default)(value)
    else:
        expected = type(default).__name__
    raise ReplayOptionError(f"{where}: parameter {name} is {value!r}; it must be a {expected}")


def _fits(value: Any, example: Any) -> bool:
    if isinstance(example, bool) or isinstance(value, bool):
        return isinstance(value, bool) and isinstance(example, bool)
    return isinstance(value, (int, float) if isinstance(example, float) else type(example))
