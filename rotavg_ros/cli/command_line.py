"""Reconstructs the command that made a report from the parsed arguments."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Collection, Iterator
from typing import Any

# Paths do not affect the figures, and are private.
_PLACES = frozenset({"output", "keep", "data"})


def command_line(
    parser: argparse.ArgumentParser, arguments: argparse.Namespace, left_out: Collection[str] = _PLACES
) -> str:
    """What to type for these arguments: positional words, then the options that differ from their defaults.

    Args:
        parser: of the whole command, with its subcommands.
        arguments: the parsed arguments.
        left_out: destinations of options that the command does not show.
    """
    return shlex.join([parser.prog, *_words(parser, arguments, left_out)])


def _words(parser: argparse.ArgumentParser, arguments: argparse.Namespace, left_out: Collection[str]) -> Iterator[str]:
    # Those with a value in the arguments; --help and --version have none.
    actions = [action for action in parser._actions if hasattr(arguments, action.dest)]
    subcommands = [action for action in actions if isinstance(action, argparse._SubParsersAction)]
    positional = [action for action in actions if not action.option_strings and action not in subcommands]
    for action in positional:
        yield from _texts(getattr(arguments, action.dest))
    for action in actions:
        value = getattr(arguments, action.dest)
        if action.option_strings and action.dest not in left_out and not _are_equal(value, action.default):
            yield from _option(action, value)
    for action in subcommands:
        name = getattr(arguments, action.dest)
        yield from (name, *_words(action.choices[name], arguments, left_out))


def _option(action: argparse.Action, value: Any) -> Iterator[str]:
    name = next((text for text in action.option_strings if text.startswith("--")), action.option_strings[0])
    if isinstance(action, argparse.BooleanOptionalAction):
        yield name if value else f"--no-{name.removeprefix('--')}"
    elif action.nargs == 0:
        yield name
    elif isinstance(action, argparse._AppendAction):
        for text in _texts(value):
            yield from (name, text)
    else:
        yield from (name, *_texts(value))


def _texts(value: Any) -> list[str]:
    if isinstance(value, (list, tuple)):
        return [text for item in value for text in _texts(item)]
    # The shortest text that means the same number.
    short = f"{value:g}" if isinstance(value, float) else str(value)
    return [short if not isinstance(value, float) or float(short) == value else repr(value)]


def _are_equal(value: Any, default: Any) -> bool:
    """Whether a value equals its default, which may be a tuple where argparse makes a list."""
    is_listed = isinstance(value, list) and isinstance(default, (list, tuple))
    return list(value) == list(default) if is_listed else bool(value == default)
