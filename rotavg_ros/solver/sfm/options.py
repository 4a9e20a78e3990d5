"""Which stages of the SfM profile run."""

from __future__ import annotations

from dataclasses import dataclass

# What the paper's text has otherwise than this package: cameras' axes as they are given, its networks and its tree, and
# CleanNet's word as it is, whatever triangles say.
PAPER_PARTS = frozenset({"axes", "cleannet", "cycles", "tree", "finenet"})


@dataclass(frozen=True)
class SfmStages:
    """Every method has the bootstrap, a spanning tree.

    Attributes:
        clean: CleanNet rectifies and scores the edges.
        fine_tunings: how often FineNet corrects the orientations.
        refine: refinement ends the solve.
        weighted: refinement begins by weighing the edges by CleanNet's scores.
        shaped: the refinement estimates the noise's shape; otherwise noise is taken to be round.
        density: the last steps go by the density that makes residuals likeliest; otherwise all by that of ℓ½.
        stated: precisions that edges state are believed as far as residuals bear them out; otherwise not at all.
        stated_shapes: and so is the information that they state, about which axes they are exact.
        cycles: triangles tell how far CleanNet's scores are borne out, and what they say of edges themselves counts.
        consensus: after the refinement another answer is looked for where edges that it rejects agree with each other.
        as_written: of :data:`PAPER_PARTS`, those that run as the paper's text has them, not as this package does.
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
