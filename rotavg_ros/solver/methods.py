"""The methods by name, what each runs in either profile; profiles and devices to choose from. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass, field

from rotavg_ros.solver.sfm.options import SfmStages
from rotavg_ros.solver.slam.options import SlamStages


@dataclass(frozen=True)
class Method:
    """The stages that run; what one profile does not have leaves the other as the whole does it."""

    sfm: SfmStages = field(default_factory=SfmStages)
    slam: SlamStages = field(default_factory=SlamStages)


def _without_refinement(clean: bool, fine_tunings: int) -> Method:
    return Method(SfmStages(clean, fine_tunings, refine=False), SlamStages(clean, refine=False))


DEFAULT_METHOD = "neurora"
NETWORK_METHODS = {
    DEFAULT_METHOD: Method(),
    "neurora-paper": _without_refinement(clean=True, fine_tunings=1),
    "neurora-v2": _without_refinement(clean=True, fine_tunings=2),
    "cleannet-spt": _without_refinement(clean=True, fine_tunings=0),
    "spt-finenet": _without_refinement(clean=False, fine_tunings=1),
    "spt": _without_refinement(clean=False, fine_tunings=0),
    # Ablations: what each network and the noise's shape earn.
    "neurora-unweighted": Method(sfm=SfmStages(weighted=False)),
    "neurora-without-finenet": Method(sfm=SfmStages(fine_tunings=0)),
    "neurora-without-cleannet": Method(SfmStages(clean=False), SlamStages(clean=False)),
    "neurora-without-both": Method(SfmStages(clean=False, fine_tunings=0), SlamStages(clean=False)),
    "neurora-round": Method(sfm=SfmStages(shaped=False)),
    "neurora-odometry-start": Method(slam=SlamStages(tree_start=False)),
    "neurora-stated-precisions": Method(slam=SlamStages(scale_estimation=False)),
    "neurora-without-slip-search": Method(slam=SlamStages(slip_search=False)),
}
# Others' methods, to compare with.
BASELINES = ("chatterjee", "weiszfeld", "arrigoni", "wang")
METHODS = (*NETWORK_METHODS, *BASELINES)
PROFILES = ("auto", "slam", "sfm")
DEVICES = ("auto", "cpu", "cuda")
