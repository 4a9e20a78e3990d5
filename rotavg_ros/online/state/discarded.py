"""What an estimator has forgotten or replaced, while it can still be backed up."""

from __future__ import annotations

from pathlib import Path

from rotavg_ros.online.content import ContentState
from rotavg_ros.online.state.backups import back_up
from rotavg_ros.online.state.content import collect


class Discarded:
    """A graph that was forgotten or replaced, and everything that belonged to it; it does not change any more."""

    def __init__(self, content: ContentState) -> None:
        self._content = content

    @property
    def num_keyframes(self) -> int:
        return self._content.growth.graph.num_keyframes

    def back_up(self, path: Path) -> Path:
        """Write it beside a state file, as a file that can be loaded; returns its path.

        Raises:
            StateFileError: it cannot be written, see :func:`~rotavg_ros.online.state.backups.back_up`.
        """
        return back_up(path, collect(self._content).encoded())
