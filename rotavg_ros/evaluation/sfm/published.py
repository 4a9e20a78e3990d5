"""Figures that the NeuRoRA paper (Purkait, Chin & Reid, ECCV 2020) publishes, for the column next to ours.

Only what was read in the paper itself belongs here. Its synthetic table has not been at hand yet, so those cells stay
empty.
"""

from __future__ import annotations

from typing import NamedTuple


class Published(NamedTuple):
    """Mean and median error over the paper's synthetic test graphs, degrees."""

    mean_deg: float
    median_deg: float


SYNTHETIC: dict[str, Published] = {}
