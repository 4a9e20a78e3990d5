"""Options: dataclass fields with meaning and bounds, defined once for the library, the node and a replay."""

from __future__ import annotations

import math
import os
import textwrap
from array import array
from dataclasses import dataclass, field, fields, replace
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from rotavg_ros.errors import UserError

_KINDS = {
    bool: ("true or false", "true or false"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("text", "texts"),
}
_NUMBERS: dict[type, type] = {int: Integral, float: Real}  # numpy's as well
_Class = TypeVar("_Class", bound=type)


class OptionError(UserError):
    """Options that are invalid, alone or together."""


@dataclass(frozen=True)
class Unit:
    """The unit in which users write an option, if it differs from the field's or is not part of the field's name.

    Attributes:
        suffix: appended to the field's name.
        inside: the field's unit.
        size: size of the users' unit in the field's unit.
    """

    suffix: str = ""
    inside: str = ""
    size: float = 1.0


AS_NAMED = Unit()
DEGREES = Unit("_deg", "radians", math.pi / 180)
DEGREES_PER_SECOND = Unit("_deg_s", "rad/s", math.pi / 180)
METRES = Unit("_m", "metres")
METRES_PER_SECOND = Unit("_m_s", "m/s")


@dataclass(frozen=True)
class Option:
    """One option as users write it: in files, on the command line, to a node.

    Attributes:
        field: name of the dataclass's field, whose value is in ``unit.inside``.
        default: as users write it.
        description: what it means.
        within: its bounds as users write them, both allowed; None: any number.
        choices: the allowed texts; none: any.
        live: whether it can be changed while a node runs.
        unit: the unit in which users write it.
    """

    field: str
    default: Any
    description: str
    within: tuple[float, float] | None
    choices: tuple[str, ...]
    live: bool
    unit: Unit

    @property
    def name(self) -> str:
        """The name as users write it."""
        return self.field + self.unit.suffix

    @property
    def range(self) -> str:
        """Its bounds as text; empty if it has none."""
        return "{:g} … {:g}".format(*self.within) if self.within else ""

    def to_field(self, written: Any) -> Any:
        """Convert a value as users write it to the field's unit."""
        return written if self.unit.size == 1 else written * self.unit.size

    def written(self, options: Any) -> Any:
        """The value in a dataclass as users write it, to 15 digits, so that 7° in radians is 7° again."""
        value = getattr(options, self.field)
        return value if self.unit.size == 1 or not _is(float, value) else float(f"{value / self.unit.size:.15g}")

    def checked(self, written: Any) -> Any:
        """A value in the option's own type: a float for a whole number, a tuple for a list.

        Raises:
            OptionError: a wrong type, not one of the choices, or out of range.
        """
        if isinstance(self.default, tuple):
            kind = type(self.default[0])
            if not isinstance(written, (list, tuple, array)) or not all(_is(kind, entry) for entry in written):
                self._refuse(written, f"it must be a list of {_KINDS[kind][1]}")
            return tuple(kind(entry) for entry in written)
        kind = type(self.default)
        if not _is(kind, written):
            self._refuse(written, f"it must be {_KINDS[kind][0]}")
        value = kind(written)
        if self.choices and value not in self.choices:
            self._refuse(value, f"choose from {', '.join(self.choices)}")
        if self.within and not self.within[0] <= value <= self.within[1]:
            self._refuse(value, "it must be between {:g} and {:g}".format(*self.within))
        return value

    def _refuse(self, value: Any, remedy: str) -> NoReturn:
        raise OptionError(f"{self.name} is {value!r}; {remedy}")


def option(
    default: Any,
    description: str,
    *,
    within: tuple[float, float] | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
    unit: Unit = AS_NAMED,
) -> Any:
    """A dataclass field with an :class:`Option`; the default and the bounds are as users write them."""
    described = Option("", default, description, within, choices, live, unit)
    return field(default=described.to_field(default), metadata={"option": described})


@cache
def options_of(owner: type) -> tuple[Option, ...]:
    """The options of a dataclass, in its order; other fields are skipped."""
    described = [each for each in fields(owner) if "option" in each.metadata]
    return tuple(replace(each.metadata["option"], field=each.name) for each in described)


def check_options(options: Any) -> None:
    """Check all options of a dataclass's instance.

    Raises:
        OptionError: the first invalid one, with its name and value as users write them.
    """
    owner: type = type(options)
    for each in options_of(owner):
        each.checked(each.written(options))


def path_of(written: str) -> Path | None:
    """The path that an option names; None if it is empty.

    ``~`` is the home folder: in a parameter file, or behind ``name:=``, no shell has put it there.
    """
    return Path(os.path.expanduser(written)) if written else None


def documented(owner: _Class) -> _Class:
    """A class decorator that appends the meaning of every option to the docstring."""

    def wrap(each: Option) -> list[str]:
        return textwrap.wrap(_told(each), 108, subsequent_indent="    ", break_on_hyphens=False)

    lines = [line for each in options_of(owner) for line in wrap(each)]
    owner.__doc__ = f"{(owner.__doc__ or '').rstrip()}\n\n    Attributes:\n" + textwrap.indent(
        "\n".join(lines), " " * 8
    )
    return owner


def _told(each: Option) -> str:
    unit = f"in {each.unit.inside}; {each.name}: " if each.unit.inside else ""
    allowed = f"one of {', '.join(each.choices)}" if each.choices else each.range
    return f"{each.field}: {each.description} ({unit}default {each.default!r}{allowed and f'; {allowed}'})."


def _is(kind: type, value: Any) -> bool:
    """Whether a value is of a kind; an int counts as a float, and neither counts as a bool."""
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, _NUMBERS.get(kind, kind))
