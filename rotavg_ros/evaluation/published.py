"""Figures that the NeuRoRA paper (Purkait, Chin & Reid, ECCV 2020) publishes, for the column next to ours.

Degrees only, of its synthetic table. They were written down from memory, without the paper at hand: check them there
before citing them. What is not remembered with confidence (combinations, seconds, the robustness table) is left out.
"""

from __future__ import annotations

from typing import NamedTuple


class Published(NamedTuple):
    """Mean and median error over the paper's synthetic test graphs, degrees."""

    mean_deg: float
    median_deg: float


SYNTHETIC: dict[str, Published] = {
    "chatterjee": Published(2.17, 1.25),
    "weiszfeld": Published(3.35, 1.02),
    "arrigoni": Published(2.92, 1.42),
    "wang": Published(2.77, 1.40),
    "cleannet-spt": Published(2.93, 1.47),
    "neurora-paper": Published(1.45, 0.74),
    "neurora-v2": Published(1.30, 0.68),
}
