"""Keys that are there twice in a YAML text: YAML forbids them, yet its readers, ROS's too, silently take the last."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import yaml

_MERGE = "tag:yaml.org,2002:merge"


class RepeatedKey(NamedTuple):
    """A key that stands a second time in the same mapping.

    Attributes:
        path: the keys that lead to it, itself the last.
        line, first_line: where it stands, and where it stood first, from 1.
    """

    path: tuple[str, ...]
    line: int
    first_line: int

    def told(self, file: object) -> str:
        """A line for the user about it."""
        return f"{file}:{self.line}: {self.path[-1]} is there already in line {self.first_line}; leave one of them"


def repeated_keys(text: str) -> Iterator[RepeatedKey]:
    """All of them, mapping by mapping; keys count as the same if they are written alike.

    Raises:
        yaml.YAMLError, RecursionError: not YAML, or nested too deeply.
    """
    loader = yaml.SafeLoader(text)
    try:
        root = loader.get_single_node()
    finally:
        loader.dispose()
    waiting: list[tuple[yaml.Node | None, tuple[str, ...]]] = [(root, ())]
    seen: set[int] = set()  # aliases may lead back
    while waiting:
        node, path = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting += [(each, path) for each in reversed(node.value)]
        if not isinstance(node, yaml.MappingNode):
            continue
        first_line: dict[tuple[str, str], int] = {}
        below = []
        for key, value in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else ""
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                line = key.start_mark.line + 1
                if (key.tag, name) in first_line:
                    yield RepeatedKey((*path, name), line, first_line[key.tag, name])
                first_line.setdefault((key.tag, name), line)
            below.append((value, (*path, name)))
        waiting += reversed(below)
