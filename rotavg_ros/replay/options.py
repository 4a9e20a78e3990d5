"""The node's parameters for a replay: from its own YAML files and from words ``name:=value``."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from rotavg_ros.errors import UserError
from rotavg_ros.option import OptionError
from rotavg_ros.settings.parameters import NODE_NAME, PARAMETERS

Values = dict[str, Any]


class ReplayOptionError(UserError):
    """A parameter that the node does not have, or a value that it cannot have."""


def read_parameter_file(path: Path) -> Values:
    """What a file for ``--params-file`` says about the node; ``qos_overrides`` have no meaning here.

    Raises:
        ReplayOptionError: no such file, not YAML, not a parameter file of the node, or a value that cannot be.
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
        ReplayOptionError: another form, an unknown name, or a value that cannot be.
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
    """The value in its parameter's own type."""
    if name not in PARAMETERS:
        close = difflib.get_close_matches(name, list(PARAMETERS), n=1)
        hint = f"did you mean {close[0]}?" if close else "see `rotavg_node --print-parameters`"
        raise ReplayOptionError(f"{where}: unknown parameter {name}; {hint}")
    try:
        return PARAMETERS[name].checked(value)
    except OptionError as error:
        raise ReplayOptionError(f"{where}: {error}") from None
