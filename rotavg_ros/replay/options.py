"""The node's parameters for a replay: from its own YAML files and from words ``name:=value``."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from rotavg_ros.errors import UserError
from rotavg_ros.option import OptionError
from rotavg_ros.settings.parameter_file import ANY_NODE, repeated_parameter
from rotavg_ros.settings.parameters import NODE_NAME, PARAMETERS

Values = dict[str, Any]

# Prefixes of the parameters that rclpy gives every node.
_RCLPYS = ("qos_overrides.", "start_type_description_service", "use_sim_time")


class ReplayOptionError(UserError):
    """A parameter that the node does not have, or an invalid value."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Takes for numbers what ROS takes for numbers: 1e-1, but no dates (2024-01-31) and no times (1:30)."""


_YAML = "tag:yaml.org,2002:"
_OF_ROS = {
    "int": re.compile(r"[-+]?(0[0-7]*|[1-9]\d*|0x[\da-fA-F]+)$"),
    "float": re.compile(r"[-+]?((\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$"),
}
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag.removeprefix(_YAML) not in (*_OF_ROS, "timestamp")]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _kind, _pattern in _OF_ROS.items():
    _Loader.add_implicit_resolver(f"{_YAML}{_kind}", _pattern, list("-+.0123456789"))


def _content(text: str) -> Any:
    """A YAML document."""
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def read_parameter_file(path: Path) -> tuple[Values, list[str]]:
    """The node's parameters in a file for ``--params-file``; those that only rclpy uses are ignored.

    Where the node has a namespace, its topics are in it: those that the file names, and by default the node's own.

    Returns:
        the values by name; and a line for each parameter that the node does not have, which it ignores as well.

    Raises:
        ReplayOptionError: no such file, not YAML or one that refers to itself, not a parameter file of the node, or of
            more than one, or an invalid value, or a parameter that is there twice.
    """
    try:
        text = path.read_text(encoding="utf-8")
        nodes = [(name, list(_flat(said))) for name, said in _nodes(_content(text))]
        repeated = repeated_parameter(path, text, NODE_NAME)
    except (OSError, UnicodeDecodeError) as error:
        raise ReplayOptionError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    except yaml.YAMLError as error:
        raise ReplayOptionError(f"{path}: is not YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ReplayOptionError(f"{path}: is nested too deeply, or refers to itself; write its values out") from None
    if repeated is not None:
        raise ReplayOptionError(repeated)
    of_node = {NODE_NAME, *ANY_NODE}
    meant = [(name, said) for name, said in nodes if name.rpartition("/")[2] in of_node]
    if not meant:
        raise ReplayOptionError(
            f"{path}: has no parameters of the node; expected '/{NODE_NAME}:' with 'ros__parameters:' below it, as "
            "`rotavg_node --print-parameters` writes it"
        )
    named = sorted({name for name, _ in meant if name.rpartition("/")[2] == NODE_NAME})
    if len(named) > 1:
        raise ReplayOptionError(f"{path}: has parameters of several nodes ({', '.join(named)}); leave those of one")
    values, notes = {}, []
    for name, value in (pair for _, said in meant for pair in said):
        if name in PARAMETERS:
            values[name] = _checked(name, value, str(path))
        elif not name.startswith(_RCLPYS):
            notes.append(f"{path}: unknown parameter {name} is ignored" + _meant(name, "; did you mean {}?"))
    namespace = next(iter(named), "").rpartition("/")[0]
    return values | (_in_namespace(namespace, values) if namespace.strip("/*") else {}), notes


def _in_namespace(namespace: str, values: Values) -> Values:
    """The parameters that name topics to listen to, with absolute names, as the node resolves them."""
    return {
        name: tuple(
            entry if entry.startswith("/") else f"{namespace}/{entry}"
            for entry in values.get(name, PARAMETERS[name].default)
        )
        for name in ("odometry_topics", "edge_topics")
    }


def _nodes(content: Any, name: str = "") -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Full names of nodes and the content of their ``ros__parameters``; namespaces may be nested."""
    for key, below in content.items() if isinstance(content, Mapping) else ():
        if key == "ros__parameters":
            yield name, below if isinstance(below, Mapping) else {}
        else:
            yield from _nodes(below, f"{name}/{str(key).strip('/')}")


def _flat(settings: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Parameters by name; names of nested ones are joined by dots."""
    for key, value in settings.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def read_settings(words: Iterable[str]) -> Values:
    """Parameters from words ``name:=value``, the value in YAML, as after ``--ros-args -p``.

    Raises:
        ReplayOptionError: another form, an unknown name, or an invalid value.
    """
    values: Values = {}
    for word in words:
        name, separator, text = word.partition(":=")
        if not separator:
            raise ReplayOptionError(f"-p {word}: write name:=value")
        try:
            value = _content(text)
        except (yaml.YAMLError, RecursionError):  # nested too deeply
            value = text
        values[name] = _checked(name, value, "-p")
    return values


def _checked(name: str, value: Any, where: str) -> Any:
    """The value in its parameter's own type."""
    if name not in PARAMETERS:
        hint = _meant(name, "did you mean {}?") or "see `rotavg_node --print-parameters`"
        raise ReplayOptionError(f"{where}: unknown parameter {name}; {hint}")
    try:
        return PARAMETERS[name].checked(value)
    except OptionError as error:
        raise ReplayOptionError(f"{where}: {error}") from None


def _meant(name: str, words: str) -> str:
    """A question whether a parameter with a similar name is meant; empty if there is none."""
    close = difflib.get_close_matches(name, list(PARAMETERS), n=1)
    return words.format(close[0]) if close else ""
