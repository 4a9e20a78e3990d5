"""Which stages of the SfM profile run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SfmStages:
    """Every method has the bootstrap, a spanning tree.

    Attributes:
        clean: CleanNet rectifies and scores the edges.
        fine_tunings: how often FineNet corrects the orientations.
        refine: refinement ends the solve.
        weighted: refinement begins by weighing the edges by CleanNet's scores.
        shaped: the refinement estimates the noise's shape; otherwise noise is taken to be round.
        stated: precisions that edges state are believed as far as residuals bear them out; otherwise not at all.
        as_written: networks, tree and cameras' axes as the paper's text has them, not as this package does.
    """

    clean: bool = True
    fine_tunings: int = 1
    refine: bool = True
    weighted: bool = True
    shaped: bool = True
    stated: bool = True
    as_written: bool = False
