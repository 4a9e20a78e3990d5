"""The stress suite: pose graphs that are each hard in one known way, with known true labels and variances."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from rotavg_ros.datasets.simulation.stress.kinds import KINDS, REPORTING_SEEDS, TUNING_SEEDS, StressKind
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.cases import SLAM, Case, CaseKey, Kind, drawings

__all__ = ["REPORTING_SEEDS", "TUNING_SEEDS", "StressSuiteError", "ablation_cases", "kinds"]

# The truth is exact; errors below this do not matter to a robot.
_FLOOR = float(np.radians(0.1))
_ABLATION_SEEDS = TUNING_SEEDS[:3]


class StressSuiteError(UserError):
    """No kind has such a name; the message lists some that exist."""


def kinds(names: Sequence[str] = (), *, translations: bool = False) -> list[Kind]:
    """Those whose names contain one of the given texts, in the order of the list; without any, all.

    Args:
        names: parts of names, upper or lower case.
        translations: graphs have those of their edges.

    Raises:
        StressSuiteError: a text that is in no name.
    """
    for text in names:
        if not any(_matches(text, kind) for kind in KINDS):
            worlds = ", ".join(dict.fromkeys(kind.world for kind in KINDS))
            raise StressSuiteError(f"no kind's name contains {text!r}; names begin with {worlds}")
    chosen = [kind for kind in KINDS if not names or any(_matches(text, kind) for text in names)]
    return [Kind(kind.name, partial(_drawn, kind, translations)) for kind in chosen]


def ablation_cases() -> Iterator[Case]:
    """Three tuning seeds of every kind, drawn when it is their turn: what tables of ablations count."""
    return drawings(kinds(), _ABLATION_SEEDS)


def _matches(text: str, kind: StressKind) -> bool:
    return text.casefold() in kind.name.casefold()


def _drawn(kind: StressKind, translations: bool, seed: int) -> Case:
    drawn = kind.drawn(seed)
    translation = torch.from_numpy(drawn.edge_translation) if translations else None
    return Case(
        CaseKey(kind.world, kind.name, seed),
        replace(drawn.graph, translation=translation),
        torch.from_numpy(drawn.body_from_world),
        SLAM,
        torch.from_numpy(drawn.is_intact),
        _FLOOR,
        torch.from_numpy(drawn.true_precision),
    )
