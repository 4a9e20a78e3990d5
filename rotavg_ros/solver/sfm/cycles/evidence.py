"""The evidence of triangles about every edge, used where triangles do not confirm CleanNet.

**Edges.** The three rotations of a triangle compose to the identity, up to noise, if all are good; with a false one
they compose to anything. Let g = 1 for a good edge, and λ the density of a triangle's closing angle if all three are
good (Student's t of scale s in three dimensions) over that of uniform rotations. The triangle of edges e, c and d gives

    P(angle | g_e = 1) / P(angle | g_e = 0) = 1 − q + q λ,     q = P(g_c = 1) P(g_d = 1).

Two triangles of an edge have no other edge in common (of parallel edges, one at most), so their log ratios add up, to
E_e. P(g_c) follows from all triangles of c but this one: messages are passed (sum-product, Pearl 1988; for loops of
view-graphs Zach, Klopschitz and Pollefeys, CVPR 2010) for a few rounds, although triangles of four cameras share edges.
The prior is

    logit P(g_e = 0) = b + k ℓ_e,     ℓ: CleanNet's log-odds;

b, k and s are estimated together with the g (expectation and maximisation).

**CleanNet.** It is reliable for cameras like those that it was trained on, and hardly for others. Given a probability π
that all edges of a triangle are good, from CleanNet or any other source, closing angles have the density

    π f₁(angle) + (1 − π) f₀(angle),     f₁, f₀: any, constant in shells,

and G is the gain in log-likelihood (nats) over a single density for all. E is computed from half of the triangles,
without CleanNet; both values of G are computed on the other half. CleanNet has weight a, the triangles' posterior
1 − a:

    logit P(g_e = 0) = a ℓ_e + (1 − a) (b + k ℓ_e − E_e),     a = min(1, G_CleanNet / (¼ G_triangles)).

CleanNet counts in full from a quarter on, since it predicts something else: whether an edge's own noise exceeds 20°.
Triangles of noisy edges say less about that than about their closing angles.

Closing angles depend on no choice of axes. Everything is estimated for each component independently.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.sfm.cycles.triangles import Triangles
from rotavg_ros.solver.sfm.priors import CyclePriors
from rotavg_ros.view_graph import EdgeLabel

CYCLES = CyclePriors()
# Floor of probabilities; distance of the messages' probabilities from one. Numerical.
_LEAST, _SURE = 1e-12, 1e-6


class Checked(NamedTuple):
    """The combined verdict of CleanNet and triangles.

    Attributes:
        cleaned: edges with the combined probabilities.
        is_believed: ``(C,)`` bool, components in which CleanNet counts for more than triangles.
    """

    cleaned: Cleaned
    is_believed: Tensor


def with_triangles(
    cleaned: Cleaned, component: Tensor, is_judged: bool = True, priors: CyclePriors = CYCLES
) -> Checked:
    """Outlier probabilities from CleanNet and triangles, with CleanNet's weight set by how far triangles confirm it.

    Labels are kept, and so are CleanNet's probabilities where there are no triangles.

    Args:
        cleaned: a graph whose edges run from lower to higher nodes.
        component: ``(N,)`` component of every node.
        is_judged: whether CleanNet has judged the edges.
    """
    edges, said = _Edges.of(cleaned, component), _said(cleaned, is_judged)
    few = torch.full((edges.count,), priors.few_paths, device=component.device)
    triangles = Triangles.of(cleaned.measured, few, component=component, run=priors.run)
    if len(triangles.angle) == 0:
        return Checked(cleaned, torch.full_like(few, is_judged, dtype=torch.bool))
    trust = _trust(said, triangles, edges, priors) if is_judged else said.new_zeros(edges.count)
    if bool((trust == 1).all()):
        return Checked(cleaned, trust > 0.5)
    logit = _logit_by_triangles(cleaned, component, edges, said, priors)
    of_edge = _of_each(trust, edges.component).expand_as(said)
    blended = _with_logit(cleaned, of_edge * said + (1 - of_edge) * logit)
    probability = torch.where(of_edge == 1, cleaned.outlier_probability, blended.outlier_probability)
    return Checked(replace(cleaned, outlier_probability=probability), trust > 0.5)


def by_triangles(cleaned: Cleaned, component: Tensor, priors: CyclePriors = CYCLES) -> Cleaned:
    """The same from the triangles' posterior alone, with a = 0. Arguments as above."""
    edges, said = _Edges.of(cleaned, component), _said(cleaned, True)
    return _with_logit(cleaned, _logit_by_triangles(cleaned, component, edges, said, priors))


def _said(cleaned: Cleaned, is_judged: bool) -> Tensor:
    """``(M,)`` CleanNet's log-odds."""
    said = cleaned.outlier_probability.logit(_LEAST).clamp(-NUMBERS.max_logit, NUMBERS.max_logit)
    return said if is_judged else torch.zeros_like(said)


def _logit_by_triangles(
    cleaned: Cleaned, component: Tensor, edges: _Edges, said: Tensor, priors: CyclePriors
) -> Tensor:
    """``(M,)`` b + k ℓ − E, from many triangles."""
    most = priors.paths_per_edge * torch.bincount(edges.component, minlength=edges.count)
    most = most.clamp(priors.least_paths, priors.most_paths)
    triangles = Triangles.of(cleaned.measured, most, component=component)
    return _by_triangles(triangles, _Beforehand(edges, said, priors))


def _with_logit(cleaned: Cleaned, logit: Tensor) -> Cleaned:
    """The same with other probabilities where there is no label."""
    probability = torch.sigmoid(logit.clamp(-NUMBERS.max_logit, NUMBERS.max_logit)).to(cleaned.outlier_probability)
    is_free = cleaned.measured.label == EdgeLabel.AUTOMATIC
    return replace(cleaned, outlier_probability=torch.where(is_free, probability, cleaned.outlier_probability))


@dataclass(frozen=True)
class _Edges:
    """M edges of C components.

    Attributes:
        component: ``(M,)``.
        count: C.
        label: ``(M,)`` verdicts from outside.
    """

    component: Tensor
    count: int
    label: Tensor

    @classmethod
    def of(cls, cleaned: Cleaned, component: Tensor) -> _Edges:
        graph = cleaned.measured
        return cls(component.index_select(0, graph.source), int(component.max()) + 1, graph.label)

    @cached_property
    def is_free(self) -> Tensor | None:
        """``(M,)`` bool: edges without a label; None if no edge has one."""
        is_free = self.label == EdgeLabel.AUTOMATIC
        return None if bool(is_free.all()) else is_free

    def labelled(self, logit: Tensor) -> Tensor:
        """``(M,)`` log-odds of being false, overridden by labels."""
        if self.is_free is None:
            return logit
        logit = torch.where(self.label == EdgeLabel.ACCEPTED, -NUMBERS.max_logit, logit)
        return torch.where(self.label == EdgeLabel.REJECTED, NUMBERS.max_logit, logit)


class _Beforehand:
    """Prior log-odds b + k ℓ that edges are false, before triangles are considered, with given ℓ ``(M,)``."""

    def __init__(self, edges: _Edges, said: Tensor, priors: CyclePriors) -> None:
        self.edges, self.priors = edges, priors
        self._said, self._free = said, torch.ones_like(said) if edges.is_free is None else edges.is_free.to(said)
        # In double precision: where ℓ is the same for all edges, the determinant almost vanishes.
        self._base, self._slope = (said.new_zeros(edges.count, dtype=torch.float64) for _ in range(2))
        # Bounds of the curvature of log(1 + exp(b + k ℓ)), summed over edges: it is ¼ at most (Böhning 1992).
        base, cross, slope = (self._sums(self._free * said.double() ** power / 4) for power in (0, 1, 2))
        base, slope = base + priors.base_spread**-2, slope + priors.slope_spread**-2
        self._bound = base, cross, slope, slope * base - cross**2

    def logit(self) -> Tensor:
        """``(M,)`` log-odds, overridden by labels."""
        base, slope = (_of_each(value, self.edges.component) for value in (self._base, self._slope))
        return self.edges.labelled(base.to(self._said) + slope.to(self._said) * self._said)

    def fit(self, outlier: Tensor) -> None:
        """A step of b and k towards the maximum, given the edges' current probabilities ``outlier`` ``(M,)``."""
        base, cross, slope, determinant = self._bound
        off = self._free * (outlier - torch.sigmoid(self.logit()))
        by_base = self._sums(off) - self._base * self.priors.base_spread**-2
        by_slope = self._sums(off * self._said) - self._slope * self.priors.slope_spread**-2
        self._base = self._base + (slope * by_base - cross * by_slope) / determinant
        self._slope = self._slope + (base * by_slope - cross * by_base) / determinant

    def _sums(self, value: Tensor) -> Tensor:
        """``(C,)`` sums over components, float64."""
        return _sums(value.double(), self.edges.component, self.edges.count)


def _by_triangles(triangles: Triangles, beforehand: _Beforehand) -> Tensor:
    """``(M,)`` b + k ℓ − E: log-odds of being false; ``beforehand`` is fitted."""
    edges, priors, edge = beforehand.edges, beforehand.priors, triangles.edge
    closing = _Closing(triangles.angle.float() ** 2, edges.component[edge[0]], edges.count, priors)
    message = closing.square.new_zeros(edge.shape)
    logit = beforehand.logit()
    for number in range(priors.rounds):
        good = torch.sigmoid(-logit[edge] - message)
        ratio = closing.ratio()
        others = torch.stack((good[1] * good[2], good[0] * good[2], good[0] * good[1]))
        new = torch.log1p((ratio - 1) * others.clamp_(max=1 - _SURE))
        message = new if number == 0 else (message + new) / 2  # undamped messages may alternate
        evidence = message.new_zeros(len(logit)).index_add_(0, edge.ravel(), message.ravel())
        beforehand.fit(torch.sigmoid(beforehand.logit() - evidence))
        logit = beforehand.logit() - evidence
        closing.fit(good.prod(dim=0), ratio)
    return logit


@dataclass
class _Closing:
    """Density of the closing angles of triangles of good edges (T triangles, C components).

    Attributes:
        square: ``(T,)`` rad², float32: squared closing angles.
        component: ``(T,)``.
        count: C.
    """

    square: Tensor
    component: Tensor
    count: int
    priors: CyclePriors

    def __post_init__(self) -> None:
        self._scale_square = self.square.new_full((self.count,), self.priors.first_scale**2)
        # Density of uniform rotations over rotation vectors, and the constant of Student's t.
        even = 2 * torch.sinc(self.square.sqrt() / (2 * math.pi)).log() - math.log(8 * math.pi**2)
        freedom = self.priors.freedom
        half = math.lgamma((freedom + 3) / 2) - math.lgamma(freedom / 2)
        self._constant = half - 1.5 * math.log(freedom * math.pi) - even

    def ratio(self) -> Tensor:
        """``(T,)`` λ: density of each angle if all three edges are good, over that of uniform rotations."""
        scale_square = _of_each(self._scale_square, self.component)
        freedom = self.priors.freedom
        tail = (freedom + 3) / 2 * torch.log1p(self.square / scale_square / freedom)
        return torch.exp(self._constant - 1.5 * scale_square.log() - tail)

    def fit(self, good: Tensor, ratio: Tensor) -> None:
        """A step of the scale towards the maximum, given ``good`` ``(T,)``, P(all edges good) without the angle."""
        closes = good * ratio / (1 - good + good * ratio).clamp(min=_LEAST)
        freedom = self.priors.freedom
        # Student's t is a mixture of normal densities: a large angle says less about the scale.
        weight = closes * (freedom + 3) / (freedom + self.square / _of_each(self._scale_square, self.component))
        total, known = (_sums(value, self.component, self.count) for value in (weight * self.square, closes))
        worth = self.priors.scale_triangles
        scale_square = (total / 3 + worth * self.priors.first_scale**2) / (known + worth)
        self._scale_square = scale_square.clamp(min=self.priors.least_scale**2)


def _trust(said: Tensor, triangles: Triangles, edges: _Edges, priors: CyclePriors) -> Tensor:
    """``(C,)`` a: the weight of ``said`` ``(M,)``, CleanNet's log-odds, relative to triangles."""
    saying, held_back = _halves(triangles, edges)
    if len(held_back.angle) == 0:
        return said.new_ones(edges.count)
    by_triangles = _by_triangles(saying, _Beforehand(edges, torch.zeros_like(said), priors))
    gained, possible = (_gain(logit, held_back, edges, priors) for logit in (said, by_triangles))
    # A gain that a few triangles may reach by chance is no evidence about CleanNet.
    return ((gained + priors.by_chance) / (priors.full_trust * possible + priors.by_chance)).clamp(max=1)


def _halves(triangles: Triangles, edges: _Edges) -> tuple[Triangles, Triangles]:
    """Every other triangle of each component, which stand together, and the rest."""
    if edges.count == 1:
        first, second = (Triangles(triangles.edge[:, k::2], triangles.angle[k::2].contiguous()) for k in (0, 1))
        return first, second
    component = edges.component[triangles.edge[0]]
    count = torch.bincount(component, minlength=edges.count)
    rank = torch.arange(len(component), device=component.device) - (count.cumsum(0) - count)[component]
    first, second = (Triangles(triangles.edge[:, rank % 2 == k], triangles.angle[rank % 2 == k]) for k in (0, 1))
    return first, second


def _gain(logit: Tensor, triangles: Triangles, edges: _Edges, priors: CyclePriors) -> Tensor:
    """``(C,)`` G, nats, for log-odds ``(M,)`` of being false."""
    bounds = torch.tensor(priors.shells, device=logit.device, dtype=torch.float64)
    shells = len(bounds) - 1
    # Share of uniform rotations in each shell; the prior counts as one triangle.
    volume = ((bounds - bounds.sin()) / math.pi).diff().repeat(edges.count)
    component = edges.component[triangles.edge[0]]
    shell = component * shells + torch.bucketize(triangles.angle, bounds[1:-1])

    def density(weight: Tensor) -> Tensor:
        """``(T,)`` densities in units of the uniform one."""
        inside = volume.new_zeros(len(volume)).index_add_(0, shell, weight) + volume
        total = inside.reshape(edges.count, shells).sum(dim=1, keepdim=True)
        return ((inside / volume).reshape(edges.count, shells) / total).ravel()[shell]

    def mean_angle(weight: Tensor) -> Tensor:
        total, count = (_sums(value, component, edges.count) for value in (weight * triangles.angle, weight))
        return total / count

    beforehand = torch.sigmoid(-logit.double())[triangles.edge].prod(dim=0).clamp(_LEAST, 1 - _LEAST)
    good, likelihood = beforehand, beforehand
    for _ in range(priors.density_rounds):
        of_good = beforehand * density(good)
        likelihood = of_good + (1 - beforehand) * density(1 - good)
        good = of_good / likelihood
    one_density = density(torch.ones_like(good))
    gain = _sums((likelihood / one_density).log(), component, edges.count)
    # Log-odds by which good triangles have larger closing angles than others do not identify good edges.
    return torch.where(mean_angle(good) < mean_angle(1 - good), gain.clamp(min=0), 0.0)


def _of_each(value: Tensor, group: Tensor) -> Tensor:
    """The ``value`` ``(C,)`` of each element's group; a single value if there is one group."""
    return value if len(value) == 1 else value[group]


def _sums(value: Tensor, group: Tensor, count: int) -> Tensor:
    """``(count,)`` sums by group."""
    return value.sum()[None] if count == 1 else value.new_zeros(count).index_add_(0, group, value)
