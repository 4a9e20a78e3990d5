"""The one exception family whose message is meant for a user, what makes it of the system's own, and Ctrl-C."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class UserError(Exception):
    """A mistake in what the user gave us: one line that names it and says what to do.

    The command line prints the message and exits with 2; the node logs it and refuses to start.
    """


@contextmanager
def asking_about(path: Path, error: type[UserError]) -> Iterator[None]:
    """Turn what the system answers to questions about a path (is it there, where does it lead) into a user's error."""
    try:
        yield
    except OSError as problem:  # no rights to look, a name that is too long
        raise error(f"{path}: {(problem.strerror or str(problem)).lower()}; check the path and its rights") from None
    except RuntimeError:  # pathlib's word for it up to Python 3.12
        raise error(f"{path}: its symbolic links lead in a circle; check the path") from None


def is_interruption(error: BaseException | None) -> bool:
    """Where compiled code has its result when Ctrl-C comes, Python makes a SystemError of it, and of that another."""
    while isinstance(error, SystemError):
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C ends the block, and nothing else: what is done by then is made use of."""
    try:
        yield
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interruption(error):
            raise
