"""Types of command line arguments that say in plain words what is wrong with one."""

from __future__ import annotations

import argparse


def whole_number(text: str) -> int:
    """A whole number, 0 or more."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if number < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative; it must be 0 or more")
    return number
