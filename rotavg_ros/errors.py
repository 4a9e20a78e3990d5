"""The exceptions whose messages are meant for users, their making from the system's errors, and Ctrl-C."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class UserError(Exception):
    """A mistake in the user's input: one line that names it and says what to do.

    The command line prints the message and exits with 2; the node logs it and refuses to start.
    """


@contextmanager
def asking_about(path: Path, error: type[UserError]) -> Iterator[None]:
    """Turn the system's errors about a path (does it exist, where does it lead) into a user's error."""
    try:
        yield
    except OSError as problem:  # no rights to look, a name that is too long
        raise error(f"{path}: {(problem.strerror or str(problem)).lower()}; check the path and its rights") from None
    except RuntimeError:  # raised by pathlib up to Python 3.12
        raise error(f"{path}: its symbolic links lead in a circle; check the path") from None


def in_one_line(error: BaseException) -> str:
    """What an error of rclpy says, in one line and without the places in its sources, of which users have none."""
    return re.sub(r", at /\S+\.(?:c|cpp|h|hpp):\d+", "", " ".join(str(error).split()))


def is_interruption(error: BaseException | None) -> bool:
    """Whether it is a Ctrl-C; if that comes when compiled code has its result, Python wraps it in SystemErrors."""
    while isinstance(error, SystemError):
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C ends only this block, so that what is done by then can be used."""
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interruption(error):
            raise
