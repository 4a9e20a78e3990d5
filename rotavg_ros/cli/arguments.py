"""Types of command line arguments with error messages in plain words."""

from __future__ import annotations

import argparse
import math

# The same limit as for the node's solver_threads; far more would exhaust the process's memory maps.
_MAX_THREADS = 1024
# No meaningful number of seconds, degrees or a rate exceeds this, and multiples of far larger ones may overflow.
_MAX_NUMBER = 1e12


def whole_number(text: str) -> int:
    """A whole number, 0 or more."""
    number = _whole(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"is {text}; it must be 0 or more")
    return number


def positive_whole_number(text: str) -> int:
    """A whole number, 1 or more."""
    number = _whole(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"is {text}; it must be 1 or more")
    return number


def thread_count(text: str) -> int:
    """A number of threads that a process can have."""
    number = positive_whole_number(text)
    if number > _MAX_THREADS:
        raise argparse.ArgumentTypeError(f"is {text}; it must be {_MAX_THREADS} or less")
    return number


def positive_number(text: str) -> float:
    """A number above 0."""
    number = _number(text)
    if not 0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"is {text}; it must be positive")
    return _sensible(number, text)


def non_negative_number(text: str) -> float:
    """A number, 0 or more."""
    number = _number(text)
    if not 0 <= number < math.inf:
        raise argparse.ArgumentTypeError(f"is {text}; it must be 0 or more")
    return _sensible(number, text)


def finite_number(text: str) -> float:
    """A number of either sign."""
    number = _number(text)
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"is {text}; it must be finite")
    return number


def share(text: str) -> float:
    """A number between 0 and 1."""
    number = _number(text)
    if not 0 <= number <= 1:
        raise argparse.ArgumentTypeError(f"is {text}; it must lie between 0 and 1")
    return number


def _sensible(number: float, text: str) -> float:
    if number > _MAX_NUMBER:
        raise argparse.ArgumentTypeError(f"is {text}; it must be {_MAX_NUMBER:g} or less")
    return number


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
