"""Which stages of the SfM profile run."""

from __future__ import annotations

from dataclasses import dataclass

# Parts in which the paper's text differs from this package: cameras' axes as given, its networks and its tree, and
# CleanNet's scores unchanged by triangles.
PAPER_PARTS = frozenset({"axes", "cleannet", "cycles", "tree", "finenet"})


@dataclass(frozen=True)
class SfmStages:
    """Switches of the stages; every method has the bootstrap, a spanning tree.

    Attributes:
        clean: CleanNet rectifies and scores the edges.
        fine_tunings: number of times FineNet corrects the orientations.
        refine: the solve ends with the refinement.
        weighted: the refinement's coarse steps weight edges by CleanNet's scores.
        shaped: the refinement estimates the noise's shape; otherwise noise is assumed round.
        density: the last steps use the density of highest likelihood; otherwise all use that of ℓ½.
        stated: precisions that edges state are believed as far as residuals confirm them; otherwise not at all.
        stated_shapes: likewise for the axes about which edges state to be exact.
        cycles: triangles tell how far CleanNet's scores are confirmed, and add their own evidence about edges.
        consensus: after the refinement, another answer is sought where rejected edges agree with each other.
        as_written: those of :data:`PAPER_PARTS` that run as in the paper's text, not as in this package.
    """

    clean: bool = True
    fine_tunings: int = 1
    refine: bool = True
    weighted: bool = True
    shaped: bool = True
    density: bool = True
    stated: bool = True
    stated_shapes: bool = True
    cycles: bool = True
    consensus: bool = True
    as_written: frozenset[str] = frozenset()
