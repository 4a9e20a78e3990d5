"""Words about numbers, for what people read."""

import re
from collections.abc import Callable, Iterable

_NEARLY_ALL = 0.9
_BETWEEN = r"\bbetween nodes (\d+) and (\d+)"


def counted(number: int, what: str) -> str:
    """A number of things, named in the singular: ``1 edge``, ``2 edges``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def unless_nearly_all(known: int, total: int, what: str) -> str:
    """Where a figure is known, if that is not nearly everywhere: `` at 3 of 164 keyframes``; else nothing.

    Args:
        what: in the plural.
    """
    return "" if known > _NEARLY_ALL * total else f" at {known} of {total} {what}"


def between_nodes(first: int, last: int) -> str:
    """Where in a graph, by the rows of two nodes: what :func:`with_names` finds again."""
    return f"between nodes {first} and {last}"


def with_names(sentences: Iterable[str], name_of: Callable[[int], object]) -> tuple[str, ...]:
    """Sentences in which nodes have their names instead of their rows, wherever :func:`between_nodes` says them."""

    def named(found: re.Match[str]) -> str:
        first, last = (name_of(int(row)) for row in found.groups())
        return f"between nodes {first} and {last}"

    return tuple(re.sub(_BETWEEN, named, sentence) for sentence in sentences)


def without_rows(sentences: Iterable[str]) -> tuple[str, ...]:
    """Sentences about a graph whose nodes have other rows now, so that theirs say nothing any more."""
    return tuple(re.sub(_BETWEEN, "before nodes were dropped", sentence) for sentence in sentences)
