"""The one exception family whose message is meant for a user."""

from __future__ import annotations


class UserError(Exception):
    """A mistake in what the user gave us: one line that names it and says what to do.

    The command line prints the message and exits with 2; the node logs it and refuses to start.
    """
