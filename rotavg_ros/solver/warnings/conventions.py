"""Signs in measurements that a convention was mistaken.

Loop closures are compared with the odometry between their ends, as stated and under a hypothesis: rotations inverted,
quaternions in another order. Only closures that the hypothesis turns by 30° or more count: an identity is its own
inverse and supports neither.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.warnings.odometry import STRETCH, Odometry, Reading, unchanged
from rotavg_ros.view_graph import ViewGraph

# Tolerances in degrees within which a closure agrees with a prediction: the noise that makes an edge of a robot's graph
# an outlier, and twice as much for odometry that drifts; and the minimum number of closures for each. Of fewer, more
# than half agree by chance with a probability above 3e-5 (in the plane, where random rotations agree with probability
# 1/18 or 1/9).
_TOLERANCES = ((10.0, 8), (20.0, 16))
_MIN_COMPARED = _TOLERANCES[0][1]
# False closures of one pair of places agree with each other, and so may all agree with a prediction by chance. So
# agreeing closures must join at least this many pairs of stretches.
_MIN_PLACES = 3
# A closure tells two readings apart if they differ by this many tolerances.
_TELLS = 3.0
# Maximum number of closures that are compared, those with the shortest ways along odometry.
_MAX_COMPARED = 200
# A hypothesis is reported if less than the first share agrees without it and more than the second with it. Random
# closures never reach the second; closures as stated fall below the first only if 70 % of them are wrong.
_SHARE_AS_STATED, _SHARE_OTHERWISE = 0.3, 0.6
# Among hypotheses whose shares differ by at most this factor, the first is reported.
_NEARLY = 0.9
# The median odometry edge turns by less than the first angle, rad, and by more than the second if the quaternion's
# order is mistaken: w = cos(θ/2) in x's place makes a turn by θ one by 180° - θ or more. With fewer edges than compared
# closures this is not decisive: one random rotation in seventeen looks like that.
_SMALL_STEP, _LARGE_STEP = math.radians(60.0), math.radians(120.0)


def _reordered(quaternions: Tensor) -> Tensor:
    """Corrects (w, x, y, z) that was taken for (x, y, z, w)."""
    return quaternions[:, [1, 2, 3, 0]]


def _inversely_reordered(quaternions: Tensor) -> Tensor:
    """The same if the file or message holds the inverse of what is stored."""
    return rotations.inverse(_reordered(rotations.inverse(quaternions)))


class _Hypothesis(NamedTuple):
    """A reading of rotations, and the edges to which it applies."""

    odometry: Reading
    closures: Reading
    whose: str
    is_order: bool


_INVERTED = _Hypothesis(unchanged, rotations.inverse, "the closures'", False)
_OR_THOSE = "they (or the odometry's instead, if all turn about one axis)"
_CLOSURES_REORDERED = (
    _Hypothesis(unchanged, _inversely_reordered, "the closures'", True),
    _Hypothesis(unchanged, _reordered, "the closures'", True),
)
# If all are reordered, it makes no difference whether the inverse was written, up to half a turn of the world about z.
_ODOMETRY_REORDERED = (
    _Hypothesis(_inversely_reordered, _inversely_reordered, "all", True),
    _Hypothesis(_inversely_reordered, unchanged, "the odometry's", True),
)
# In the plane, inverting all changes no agreement, and inverting odometry is equivalent to inverting closures.
_ODOMETRY_INVERTED = (
    _Hypothesis(rotations.inverse, unchanged, "the odometry's", False),
    _Hypothesis(rotations.inverse, rotations.inverse, "all", False),
)


class _Agreement(NamedTuple):
    """Numbers of closures compared, agreeing within ``degrees`` as stated, and agreeing under a hypothesis.

    The last join ``places`` pairs of stretches.
    """

    hypothesis: _Hypothesis
    degrees: float
    compared: int
    as_stated: int
    otherwise: int
    places: int

    @property
    def is_striking(self) -> bool:
        return (
            self.compared >= dict(_TOLERANCES)[self.degrees]
            and self.as_stated < _SHARE_AS_STATED * self.compared
            and self.otherwise > _SHARE_OTHERWISE * self.compared
            and self.places >= _MIN_PLACES
        )

    @property
    def share(self) -> float:
        """Share of the compared closures that agree under the hypothesis."""
        return self.otherwise / self.compared

    def __str__(self) -> str:
        whose = self.hypothesis.whose
        changed = "in the order w, x, y, z" if self.hypothesis.is_order else "inverted"
        return (
            f"{self.as_stated} of {self.compared} loop closures agree with the odometry between their ends within "
            f"{self.degrees:.0f}°, and {self.otherwise} would with {whose} rotations {changed}"
        )


def mistaken_convention(odometry: Odometry, closures: ViewGraph) -> str | None:
    """Warns of inverted rotations or another order of quaternions, in the closures, the odometry or both."""
    tells = odometry.component[closures.source] == odometry.component[closures.target]
    closures = closures.select_edges(tells.nonzero()[:, 0])
    stated, reordered = (odometry.median_angle(reading) for reading in (unchanged, _reordered))
    is_enough = odometry.graph.num_edges >= _MIN_COMPARED
    is_reordered = is_enough and stated > _LARGE_STEP and reordered < _SMALL_STEP
    agreements = []
    if closures.num_edges >= _MIN_COMPARED:
        agreements = list(_agreements(odometry, closures, is_reordered))
    most = max((agreement.share for agreement in agreements), default=0.0)
    best = next((agreement for agreement in agreements if agreement.share >= _NEARLY * most), None)
    order = "w, x, y, z may have been written where x, y, z, w is read: write x, y, z, w"
    if is_reordered:
        whose = "their" if best is None else best.hypothesis.whose
        return (
            f"the median odometry edge turns by {math.degrees(stated):.0f}°, and would turn by "
            f"{math.degrees(reordered):.0f}° with {whose} quaternions in the order w, x, y, z; {order}"
        )
    if best is None:
        return None
    if best.hypothesis.is_order:
        return f"{best}; {order}"
    return (
        f"{best}; {_OR_THOSE if best.hypothesis == _INVERTED else 'they'} may state the source's orientation in the "
        "target's frame, but the target's in the source's frame is read: invert them; or, if their translations "
        "say the same, swap source and target of these edges"
    )


def _agreements(odometry: Odometry, closures: ViewGraph, is_reordered: bool) -> Iterator[_Agreement]:
    """Striking agreements. Inversion turns only some closures; readings that turn all are tried only if few agree."""
    level = odometry.level()
    nearest = (level[closures.source] - level[closures.target]).abs().argsort(stable=True)
    closures = closures.select_edges(nearest)
    ends = torch.stack((level[closures.source], level[closures.target])).sort(dim=0)[0] // STRETCH
    stated = _errors(odometry.orientation, closures, unchanged)
    angle_as_stated = torch.rad2deg(rotations.angle(stated))
    if not is_reordered and int((angle_as_stated > _TOLERANCES[0][0]).sum()) <= _SHARE_OTHERWISE * _MIN_COMPARED:
        return
    hypotheses: tuple[_Hypothesis, ...] = (_INVERTED,)
    if is_reordered:
        hypotheses = _ODOMETRY_REORDERED
    elif bool((angle_as_stated[:_MAX_COMPARED] < _TOLERANCES[0][0]).double().mean() < _SHARE_AS_STATED):
        hypotheses = (_INVERTED, *_CLOSURES_REORDERED, *_ODOMETRY_INVERTED)
        # In another order, odometry that turns little would turn by half a turn at every edge.
        if odometry.median_angle(_reordered) < _LARGE_STEP:
            hypotheses = (*hypotheses, *_ODOMETRY_REORDERED)
    composed = {reading: odometry.read_as(reading) for reading in {hypothesis.odometry for hypothesis in hypotheses}}
    for hypothesis in hypotheses:
        errors = _errors(composed[hypothesis.odometry], closures, hypothesis.closures)
        angle, apart = (
            torch.rad2deg(value) for value in (rotations.angle(errors), rotations.angle_between(stated, errors))
        )
        for degrees, _ in _TOLERANCES:
            tells = (apart > _TELLS * degrees).nonzero()[:_MAX_COMPARED, 0]
            as_stated = int((angle_as_stated[tells] < degrees).sum())
            agree = tells[angle[tells] < degrees]
            places = np.unique(ends[:, agree].numpy(), axis=1).shape[1]
            agreement = _Agreement(hypothesis, degrees, len(tells), as_stated, len(agree), places)
            if agreement.is_striking:
                yield agreement


def _errors(orientation: Tensor, closures: ViewGraph, reading: Reading) -> Tensor:
    """``(n, 4)`` closures' residuals under orientations ``(N, 4)``."""
    measured = reading(closures.target_from_source)
    return edge_residual(orientation, measured, closures.source, closures.target)
