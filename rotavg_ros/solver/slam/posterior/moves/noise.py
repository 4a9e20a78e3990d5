"""Other noise for the same labels: how far stated precisions are believed, what closures share, and for how long."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.rows import with_noise
from rotavg_ros.solver.slam.posterior.state import COMMON_SHARES, EXPONENTS, RUN_STEPS, TAIL_SHARES, TURN_SHARES

_GRIDS = {
    "turn_share": TURN_SHARES,
    "step_tails": TAIL_SHARES,
    "closure_tails": TAIL_SHARES,
    "exponent": EXPONENTS,
    "run_steps": RUN_STEPS,
    "common_share": COMMON_SHARES,
}
# Errors in common are a matter by themselves; of all else the next value tells of those beyond.
_UNORDERED = ("run_steps",)
# Where the logarithms of stated variances spread by less, weights could gain 4 % of variance at most.
_MIN_SPREAD = 0.2
# By so much both variances are off where another optimum is looked for.
_OTHER_RATIO = 8.0


def tuned(mode: Mode) -> Iterator[Mode]:
    """Modes of the same labels with other noise.

    Each value of the grids, one after the other, from the best so far; and what is found where a step's variance over a
    closure's is far larger or smaller: F may have an optimum where odometry takes up what closures err, and another.
    """
    for name, grid in _GRIDS.items():
        if not _tells(mode, name):
            continue
        begun = grid.index(getattr(mode.state.noise, name))
        for number in (*range(begun + 1, len(grid)), *range(begun - 1, -1, -1)):
            at = grid.index(getattr(mode.state.noise, name))
            if abs(number - at) > 1 and name not in _UNORDERED:
                continue
            noise = replace(mode.state.noise, **{name: grid[number]})
            found = Mode(mode.problem, *polish(mode.problem, with_noise(mode.problem, mode.state, noise)), "noise")
            yield found
            mode = min(mode, found, key=lambda either: either.cost)
    for factor in (_OTHER_RATIO, 1 / _OTHER_RATIO):
        noise = mode.state.noise
        noise = replace(
            noise, step_variance=noise.step_variance * factor, closure_variance=noise.closure_variance / factor
        )
        yield Mode(mode.problem, *polish(mode.problem, replace(mode.state, noise=noise)), "noise")


def _tells(mode: Mode, name: str) -> bool:
    """Whether the graph has anything to say of it."""
    if name == "turn_share":
        return mode.problem.turns_vary
    if name in ("step_tails", "closure_tails"):
        return "tails" not in mode.problem.without
    good = ~mode.is_false
    if good.sum() < 2:
        return False
    if name == "common_share":
        return mode.problem.system(mode.state.noise).num_runs > 0
    if name == "run_steps":
        return "common-errors" not in mode.problem.without and len(mode.problem.run) > int(mode.problem.run.max()) + 1
    is_on = "stated-precisions" not in mode.problem.without
    return is_on and float(mode.problem.stated_ratio[good].std()) >= _MIN_SPREAD
