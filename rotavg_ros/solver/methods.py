"""The methods by name, and what each of them runs; the profiles and devices to choose from. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Method:
    """Which stages run. Every method has the bootstrap, a spanning tree.

    Attributes:
        clean: CleanNet rectifies and scores the edges.
        fine_tunings: how often FineNet corrects the orientations.
        refine: refinement ends the solve.
        weighted: refinement begins by weighing the edges by CleanNet's scores.
        shaped: refinement ends in steps that know the noise's shape; otherwise it is Chatterjee & Govindu's.
        tree_start: SLAM starts from the tree of least expected error; otherwise from the odometry.
        scale_estimation: SLAM estimates the noise; otherwise it believes the precisions that edges state.
        slip_search: SLAM looks for slips in the odometry where closures speak of them.
    """

    clean: bool = False
    fine_tunings: int = 0
    refine: bool = False
    weighted: bool = True
    shaped: bool = True
    tree_start: bool = True
    scale_estimation: bool = True
    slip_search: bool = True


DEFAULT_METHOD = "neurora"
NETWORK_METHODS = {
    DEFAULT_METHOD: Method(clean=True, fine_tunings=1, refine=True),
    "neurora-paper": Method(clean=True, fine_tunings=1),
    "neurora-v2": Method(clean=True, fine_tunings=2),
    "cleannet-spt": Method(clean=True),
    "spt-finenet": Method(fine_tunings=1),
    "spt": Method(),
    # Ablations: what each network and the noise's shape earn.
    "neurora-unweighted": Method(clean=True, fine_tunings=1, refine=True, weighted=False),
    "neurora-without-finenet": Method(clean=True, refine=True),
    "neurora-without-cleannet": Method(fine_tunings=1, refine=True),
    "neurora-without-both": Method(refine=True),
    "neurora-round": Method(clean=True, fine_tunings=1, refine=True, shaped=False),
    # Ablations of the SLAM profile: they run as the whole does in that of SfM.
    "neurora-odometry-start": Method(clean=True, fine_tunings=1, refine=True, tree_start=False),
    "neurora-stated-precisions": Method(clean=True, fine_tunings=1, refine=True, scale_estimation=False),
    "neurora-without-slip-search": Method(clean=True, fine_tunings=1, refine=True, slip_search=False),
}
# By name only: they build on the solver, so that they are imported when one of them runs.
BASELINES = ("chatterjee", "weiszfeld", "arrigoni", "wang")
METHODS = (*NETWORK_METHODS, *BASELINES)
PROFILES = ("auto", "slam", "sfm")
DEVICES = ("auto", "cpu", "cuda")
