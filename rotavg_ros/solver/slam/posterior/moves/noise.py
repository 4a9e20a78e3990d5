"""Other noise for the same labels: how far stated precisions are believed, and what runs of closures share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode

# α and κ are among these: nodes of the sum that stands for the integral over them.
_GRIDS = {"exponent": (0.0, 0.5, 1.0), "common_share": (0.02, 0.15, 0.3, 0.6, 0.85)}
# Where the logarithms of stated variances spread by less, weights could gain 4 % of variance at most.
_MIN_SPREAD = 0.2


def tuned(mode: Mode) -> Iterator[Mode]:
    """Modes of the same labels with other α and κ, from neighbour to neighbour as long as F falls."""
    for name, grid in _GRIDS.items():
        if not _tells(mode, name):
            continue
        at = int(np.argmin(np.abs(np.array(grid) - getattr(mode.state.noise, name))))
        for direction in (-1, 1):
            best, place = mode, at
            while 0 <= place + direction < len(grid):
                place += direction
                noise = replace(best.state.noise, **{name: grid[place]})
                found = Mode(mode.problem, *polish(mode.problem, replace(best.state, noise=noise)), "noise")
                yield found
                if found.cost >= best.cost:
                    break
                best = found
            if best is not mode:
                mode = best
                break


def _tells(mode: Mode, name: str) -> bool:
    """Whether the good closures have anything to say of it."""
    good = ~mode.is_false
    if good.sum() < 2:
        return False
    if name == "common_share":
        return mode.problem.system.num_runs > 0
    is_on = "stated-precisions" not in mode.problem.without
    return is_on and float(mode.problem.stated_ratio[good].std()) >= _MIN_SPREAD
