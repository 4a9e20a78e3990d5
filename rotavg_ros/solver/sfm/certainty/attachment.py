"""How surely parts that few edges join to the rest of a graph are attached to it.

A camera with four edges, no two of which agree, follows one of them, which then has no residual; but most likely it is
false, and the camera is turned. So for each part (``starts/parts.py``) the posterior of its turn T is summed up:

    p(T | edges) ∝ Π_e (1 − p) ρ(W_e T⁻¹) + p φ(W_e T⁻¹)

W_e is the turn under which edge e fits, p the share of false edges, ρ the density of good edges' errors (Student's t),
φ that of false ones, both as multiples of the density of random rotations. Of an edge that the user has accepted p φ
is 0, and ρ is next to 0 where its error is not that of a good edge. There is a peak at T = 1, the answer, and others
near W_e. The integral over a peak is its height times its width, 1 / ρ(1) for one edge and m^-3/2 of that for m
that agree. What is left is the probability that all edges are false, p for each of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows as rows
from rotavg_ros.solver.algebra.pointer_jumping import lowest_common_ancestors
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.sfm.priors import AttachmentPriors
from rotavg_ros.solver.sfm.starts.parts import Parts, Turns

PRIORS = AttachmentPriors()
# Edges that only check each other in pairs have scores of their own (``series.py``).
_SEVERAL = 3


@dataclass(frozen=True)
class ErrorDensity:
    """The density of edges' errors in each of C components.

    Attributes:
        false_share: ``(C,)`` p.
        scale: ``(C,)`` rad, of good edges' errors.
        false: ``(C, S)`` density of false edges' errors in each shell of angles, over that of random rotations.
    """

    false_share: np.ndarray
    scale: np.ndarray
    false: np.ndarray

    @classmethod
    def of(
        cls, angle: np.ndarray, score: np.ndarray, component: np.ndarray, false_share: np.ndarray, noise: np.ndarray
    ) -> ErrorDensity:
        """Estimated from residuals ``(M,)`` rad, and scores, of edges in components ``(M,)``.

        Args:
            false_share: ``(C,)``.
            noise: ``(C,)`` rad, standard deviation of each component of good edges' errors.
        """
        shells, count = np.array(PRIORS.shells), len(false_share)
        volume = np.diff(shells - np.sin(shells)) / np.pi
        slot = component * len(volume) + _shell(angle)
        seen = np.bincount(slot, score * (angle > shells[0]), count * len(volume)).reshape(count, -1)
        seen = (seen + PRIORS.shell_edges * volume) / volume
        share = np.clip(false_share, PRIORS.least_false, PRIORS.most_false)
        return cls(share, np.maximum(noise, PRIORS.least_scale), seen / (seen @ volume)[:, None])

    def log_good(self, angle: np.ndarray, component: np.ndarray) -> np.ndarray:
        """Logarithm of (1 − p) ρ at ``angle`` rad, in components."""
        scale, freedom = self.scale[component], PRIORS.freedom
        constant = math.lgamma((freedom + 3) / 2) - math.lgamma(freedom / 2) - 1.5 * math.log(freedom * math.pi)
        tail = np.log1p((angle / scale) ** 2 / freedom) * (freedom + 3) / 2
        log_density = constant + math.log(8 * math.pi**2) - 3 * np.log(scale) - tail
        return np.asarray(log_density + np.log1p(-self.false_share[component]))

    def log_false(self, angle: np.ndarray, component: np.ndarray) -> np.ndarray:
        """Logarithm of p φ, likewise."""
        return np.asarray(np.log(self.false_share * self.false.T)[_shell(angle), component])


def _shell(angle: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(PRIORS.shells, angle, side="right") - 1, 0, len(PRIORS.shells) - 2)


@dataclass(frozen=True)
class Attachment:
    """What is known of K parts of a graph of N nodes, P edges in all joining them.

    Attributes:
        parts: the parts.
        body_from_world: ``(4, N)`` the answer.
        part: ``(P,)`` index of the part that an edge joins.
        is_right: ``(K,)`` probability that the part is not turned.
        variance: ``(K,)`` rad², expected square of each component of its turn.
        elsewhere: ``(P,)`` expected probability that the edge is good if the part is turned, times the probability that
            it is.
        turns: the likeliest other turn of each part that several edges join. Its change is negative if it is likelier
            than the answer, and than that all edges are false, by ``AttachmentPriors.ahead``.
    """

    parts: Parts
    body_from_world: np.ndarray
    part: np.ndarray
    is_right: np.ndarray
    variance: np.ndarray
    elsewhere: np.ndarray
    turns: Turns

    @classmethod
    def of(cls, parts: Parts, body_from_world: np.ndarray, density: ErrorDensity) -> Attachment:
        """The posterior at an answer ``(4, N)``."""
        node, part = np.unique(parts.node, return_inverse=True)
        component = parts.forest.component[node]
        stated = parts.stated(body_from_world)
        angle = rows.angle(stated[3])
        is_accepted = parts.is_accepted[parts.edge]
        here = _Peaks.of(density, _Errors(angle, is_accepted), part, component).log_mass
        false = np.where(is_accepted, -PRIORS.contradicted, np.log(density.false_share[component[part]]))
        none = np.bincount(part, false, len(node))
        tries = np.flatnonzero(angle > NUMBERS.outlier_angle)
        found: list[tuple[_Peaks, np.ndarray, np.ndarray, np.ndarray]] = []
        present = np.maximum(here, none)
        most = present.copy()
        for one, which, other in parts.pairs(tries):
            between = rows.angle(np.einsum("ip,ip->p", stated[:, one[which]], stated[:, other]))
            peaks = _Peaks.of(density, _Errors(between, is_accepted[other]), which, component[part[one]])
            np.maximum.at(most, part[one], peaks.log_mass)
            found.append((peaks, one, which, other))
        turns = _likeliest(node, part, stated, present, found)
        here, none = np.exp(here - most), np.exp(none - most)
        total, variance, elsewhere = here + none, none * rotations.RANDOM_VARIANCE, np.zeros(len(part))
        for peaks, one, which, other in found:
            # Each of the edges that agree stands for the same peak.
            mass = np.exp(peaks.log_mass - most[part[one]]) / peaks.agreeing
            total += np.bincount(part[one], mass, len(node))
            variance += np.bincount(part[one], mass * angle[one] ** 2 / 3, len(node))
            elsewhere += np.bincount(other, mass[which] * peaks.good, len(part))
        return cls(parts, body_from_world, part, here / total, variance / total, elsewhere / total[part], turns)

    def likelier(self) -> np.ndarray | None:
        """The answer ``(4, N)`` with parts turned that are likelier elsewhere; None if none is by enough."""
        chosen = self.parts.gaining(self.turns)
        return self.parts.turned(self.body_from_world, self.turns, chosen) if chosen.any() else None

    def scores(self, score: np.ndarray) -> np.ndarray:
        """Probabilities ``(M,)`` that edges are false, given those under the answer as it is."""
        is_several = (np.bincount(self.part, minlength=len(self.is_right)) >= _SEVERAL)[self.part]
        # An edge joins several parts, each within the next; the one counts that is attached least surely.
        order = np.lexsort((self.is_right[self.part], self.parts.edge))
        order = order[is_several[order]]
        edge, first = np.unique(self.parts.edge[order], return_index=True)
        chosen, score = order[first], score.copy()
        score[edge] = 1 - self.is_right[self.part[chosen]] * (1 - score[edge]) - self.elsewhere[chosen]
        return np.asarray(np.clip(score, 0.0, 1.0))

    def variances(self, reference: np.ndarray) -> np.ndarray:
        """Expected squares ``(N,)`` rad² of each component of nodes' turns relative to their ``reference`` ``(N,)``."""
        forest = self.parts.forest
        own = np.zeros(len(forest.parent))
        # A single edge's has entered as a bridge.
        is_any = np.bincount(self.part, minlength=len(self.is_right)) > 1
        node = np.unique(self.parts.node)
        own[node[is_any]] = self.variance[is_any]
        total = accumulate_to_root(forest, own)
        meeting = lowest_common_ancestors(forest.parent, self.parts.level, np.arange(len(own)), reference)
        between = total + total[reference] - 2 * total[meeting]
        return np.asarray(np.minimum(between, rotations.RANDOM_VARIANCE))


def _likeliest(
    node: np.ndarray,
    part: np.ndarray,
    stated: np.ndarray,
    present: np.ndarray,
    found: list[tuple[_Peaks, np.ndarray, np.ndarray, np.ndarray]],
) -> Turns:
    """Of the turns ``(4, P)`` stated for each part the one of most mass, beside the ``present`` one ``(K,)``."""
    tries = np.concatenate([one for _, one, *_ in found])
    mass = np.concatenate([peaks.log_mass for peaks, *_ in found])
    turns = Turns.least(node, part, tries, present[part[tries]] + PRIORS.ahead - mass, stated)
    # Two edges leave the turn open, and the misfit is spread between them.
    turns.change[np.bincount(part, minlength=len(node)) < _SEVERAL] = np.inf
    return turns


class _Errors(NamedTuple):
    """Errors ``(B,)`` rad of edges, and ``(B,)`` bool, which of these the user has accepted."""

    angle: np.ndarray
    is_accepted: np.ndarray


class _Peaks(NamedTuple):
    """G peaks of parts' posteriors, with B errors of edges there.

    Attributes:
        log_mass: ``(G,)`` logarithms of the integrals.
        good: ``(B,)`` probability that an edge is good.
        agreeing: ``(G,)`` sums of these, at least 1.
    """

    log_mass: np.ndarray
    good: np.ndarray
    agreeing: np.ndarray

    @classmethod
    def of(cls, density: ErrorDensity, errors: _Errors, peak: np.ndarray, component: np.ndarray) -> _Peaks:
        """From the errors at each ``peak`` ``(B,)``, and the peaks' components ``(G,)``."""
        angle, is_accepted = errors
        good = density.log_good(angle, component[peak])
        good -= PRIORS.contradicted * (is_accepted & (angle > NUMBERS.outlier_angle))
        false = np.where(is_accepted, -np.inf, density.log_false(angle, component[peak]))
        either = np.logaddexp(good, false)
        good = np.exp(good - either)
        agreeing = np.maximum(np.bincount(peak, good, len(component)), 1.0)
        height = density.log_good(np.zeros(len(component)), component) - np.log1p(-density.false_share[component])
        return cls(np.bincount(peak, either, len(component)) - height - 1.5 * np.log(agreeing), good, agreeing)
