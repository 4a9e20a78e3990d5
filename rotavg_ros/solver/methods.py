"""The methods by name, and what each of them runs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """Which stages run. Every method has the bootstrap, a spanning tree.

    Attributes:
        clean: CleanNet rectifies and scores the edges.
        fine_tunings: how often FineNet corrects the orientations.
        refine: refinement ends the solve.
        weighted: refinement weighs the edges by CleanNet's scores.
    """

    clean: bool = False
    fine_tunings: int = 0
    refine: bool = False
    weighted: bool = True


NETWORK_METHODS = {
    "neurora": Method(clean=True, fine_tunings=1, refine=True),
    "neurora-paper": Method(clean=True, fine_tunings=1),
    "neurora-v2": Method(clean=True, fine_tunings=2),
    "cleannet-spt": Method(clean=True),
    "spt-finenet": Method(fine_tunings=1),
    "spt": Method(),
    # Ablations: what each network earns.
    "neurora-unweighted": Method(clean=True, fine_tunings=1, refine=True, weighted=False),
    "neurora-without-finenet": Method(clean=True, refine=True),
    "neurora-without-cleannet": Method(fine_tunings=1, refine=True),
}
# By name only: they build on the solver, so that they are imported when one of them runs.
BASELINES = ("chatterjee", "weiszfeld", "arrigoni", "wang")
METHODS = (*NETWORK_METHODS, *BASELINES)
