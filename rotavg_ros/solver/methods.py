"""The methods by name with their stages in either profile, and the choices of profiles and devices; no torch import."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from rotavg_ros.errors import UserError
from rotavg_ros.solver.sfm.options import PAPER_PARTS, SfmStages
from rotavg_ros.solver.slam.options import SWITCHES as SWITCHES
from rotavg_ros.solver.slam.options import SlamStages


@dataclass(frozen=True)
class Method:
    """The stages that run in either profile; a switch that one profile lacks leaves that profile at its default."""

    sfm: SfmStages = field(default_factory=SfmStages)
    slam: SlamStages = field(default_factory=SlamStages)


def _without_refinement(clean: bool, fine_tunings: int) -> Method:
    return Method(SfmStages(clean, fine_tunings, refine=False, cycles=clean), SlamStages(clean, refine=False))


def _as_written(clean: bool, fine_tunings: int, but_for: frozenset[str] = frozenset()) -> Method:
    """The paper's method. Its text is about photos; robots' graphs use this package's versions of the same stages."""
    ours = _without_refinement(clean, fine_tunings)
    return replace(ours, sfm=replace(ours.sfm, as_written=PAPER_PARTS - but_for))


DEFAULT_METHOD = "neurora"
PAPER = "neurora-paper"
# "neurora~slips,cleannet" is ours on robots' graphs without these; "neurora-paper~tree" is the paper's with our tree.
_WITHOUT, _AND = "~", ","
NETWORK_METHODS = {
    DEFAULT_METHOD: Method(),
    "neurora-v1": _without_refinement(clean=True, fine_tunings=1),
    "neurora-v2": _without_refinement(clean=True, fine_tunings=2),
    "cleannet-spt": _without_refinement(clean=True, fine_tunings=0),
    "spt-finenet": _without_refinement(clean=False, fine_tunings=1),
    "spt": _without_refinement(clean=False, fine_tunings=0),
    # The paper's method as in its text, with networks of its own.
    PAPER: _as_written(clean=True, fine_tunings=1),
    "neurora-v2-paper": _as_written(clean=True, fine_tunings=2),
    "cleannet-spt-paper": _as_written(clean=True, fine_tunings=0),
    "spt-finenet-paper": _as_written(clean=False, fine_tunings=1),
    "spt-paper": _as_written(clean=False, fine_tunings=0),
    # Ablations of each network and the noise's shape.
    "neurora-unweighted": Method(sfm=SfmStages(weighted=False)),
    "neurora-without-finenet": Method(sfm=SfmStages(fine_tunings=0)),
    "neurora-without-cleannet": Method(SfmStages(clean=False), SlamStages(clean=False)),
    "neurora-without-both": Method(SfmStages(clean=False, fine_tunings=0), SlamStages(clean=False)),
    "neurora-without-cycles": Method(sfm=SfmStages(cycles=False)),
    "neurora-round": Method(sfm=SfmStages(shaped=False)),
    "neurora-half-norm": Method(sfm=SfmStages(density=False)),
    "neurora-equal-precisions": Method(sfm=SfmStages(stated=False)),
    "neurora-scalar-precisions": Method(sfm=SfmStages(stated_shapes=False)),
    "neurora-without-consensus": Method(sfm=SfmStages(consensus=False)),
}
# Methods of others, for comparison.
BASELINES = ("chatterjee", "geman-mcclure", "weiszfeld", "arrigoni", "wang")
METHODS = (*NETWORK_METHODS, *BASELINES)
PROFILES = ("auto", "slam", "sfm")
DEVICES = ("auto", "cpu", "cuda")
# Scale of translations: metres, so that closures are judged by them, or none that would be of use.
TRANSLATION_SCALES = ("metric", "none")


def method_named(name: str) -> Method | None:
    """The stages of a network method, None if there is none of that name.

    Args:
        name: one of :data:`NETWORK_METHODS`; "neurora~A,B" is ours on robots' graphs without A and B, out of
            :data:`rotavg_ros.solver.slam.options.SWITCHES`; "neurora-paper~A,B" is the paper's with this package's
            versions of A and B, out of :data:`rotavg_ros.solver.sfm.options.PAPER_PARTS`.
    """
    whole, *switched_off = name.split(_WITHOUT)
    if not switched_off:
        return NETWORK_METHODS.get(name)
    without = frozenset(switched_off[0].split(_AND))
    if whole == PAPER and len(switched_off) == 1 and without <= PAPER_PARTS:
        return _as_written(clean=True, fine_tunings=1, but_for=without)
    if whole != DEFAULT_METHOD or len(switched_off) > 1 or not without <= SWITCHES.keys():
        return None
    return Method(slam=SlamStages(without=without))


def check_choices(method: str, profile: str, device: str) -> None:
    """Checks that the choices exist.

    Raises:
        UserError: one does not exist; the message lists those that do.
    """
    for name in method.split("+"):
        if not is_method(name):
            raise UserError(unknown_method(name, METHODS))
    _check_choice("profile", profile, PROFILES)
    _check_choice("device", device, DEVICES)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UserError(f"unknown {name} {value!r}; choose from {', '.join(choices)}")


def unknown_method(name: str, choices: Sequence[str]) -> str:
    """Error message for an unknown method: lists the parts that can be left out, or all ``choices``."""
    whole, *parts = name.split(_WITHOUT)
    known = {DEFAULT_METHOD: sorted(SWITCHES), PAPER: sorted(PAPER_PARTS)}.get(whole, [])
    if known and len(parts) > 1:
        return f"{whole}{_WITHOUT} takes its parts after one {_WITHOUT}, with {_AND!r} between them"
    if known and parts:
        unknown = next(part for part in parts[0].split(_AND) if part not in known)
        return f"{whole}{_WITHOUT} knows no part {unknown!r}; choose from {', '.join(known)}"
    return (
        f"unknown method {name!r}; choose from {', '.join(choices)}, combine: A+B, or leave parts out: "
        f"{DEFAULT_METHOD}{_WITHOUT}A{_AND}B"
    )


def is_method(name: str) -> bool:
    """Whether a method of that name exists."""
    return name in BASELINES or method_named(name) is not None


def without(*names: str) -> str:
    """Name of the default method without some of :data:`rotavg_ros.solver.slam.options.SWITCHES`."""
    return _WITHOUT.join((DEFAULT_METHOD, _AND.join(names))) if names else DEFAULT_METHOD
