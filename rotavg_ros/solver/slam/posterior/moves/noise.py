"""Other noise for the same labels: how far stated precisions are believed, what closures share, and for how long."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.rows import with_noise
from rotavg_ros.solver.slam.posterior.state import COMMON_SHARES, EXPONENTS, RUN_STEPS

_GRIDS = {"exponent": EXPONENTS, "run_steps": RUN_STEPS, "common_share": COMMON_SHARES}
# Where the logarithms of stated variances spread by less, weights could gain 4 % of variance at most.
_MIN_SPREAD = 0.2


def tuned(mode: Mode) -> Iterator[Mode]:
    """Modes of the same labels with other α, κ and length of runs: each name's values, from the best so far."""
    for name, grid in _GRIDS.items():
        if not _tells(mode, name):
            continue
        begun = mode
        for value in grid:
            if value == getattr(begun.state.noise, name):
                continue
            noise = replace(begun.state.noise, **{name: value})
            found = Mode(mode.problem, *polish(mode.problem, with_noise(mode.problem, begun.state, noise)), "noise")
            yield found
            mode = min(mode, found, key=lambda either: either.cost)


def _tells(mode: Mode, name: str) -> bool:
    """Whether the good closures have anything to say of it."""
    good = ~mode.is_false
    if good.sum() < 2:
        return False
    if name == "common_share":
        return mode.problem.system(mode.state.noise).num_runs > 0
    if name == "run_steps":
        return "common-errors" not in mode.problem.without and len(mode.problem.run) > int(mode.problem.run.max()) + 1
    is_on = "stated-precisions" not in mode.problem.without
    return is_on and float(mode.problem.stated_ratio[good].std()) >= _MIN_SPREAD
