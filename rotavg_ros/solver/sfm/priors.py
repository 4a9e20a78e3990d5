"""The numbers of the SfM refinement, each with its unit, its source, and how much the answer depends on it.

Half and twice each value (but for the numerical floors of 10⁻⁶ and less) were tried on tuning graphs of seven kinds:
``docs/diary/sfm-refinement.md``. Where nothing is said below, the mean and the median error of each kind change by less
than 1 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NoiseShapePriors:
    """How the noise's covariance in the cameras' frames is estimated (``noise_shape.py``).

    Attributes:
        iterations, further_iterations: of the scatter's fixed point, from nothing and from the last step's scatter.
        least_ratio: of standard deviations: no axis is believed to be more exact than this share of the least exact
            one. Twice: 1–7 % worse means, 6–16 % worse medians, where noise has an exact axis. Half: 2 % better on the
            paper's recipe alone, whose noise has an axis without any; cameras have none such.
        least_deviation: radians, added to every axis, numerical: exact measurements have an inverse covariance, too.
        lower_share, typical_lengths: residuals tell the shape that are no longer than so many times this quantile. A
            quarter of normal noise is below 1.1 deviations of an axis, nearly all of it below 5; of 60 % of false
            edges so many are left out that are longer than 10. With 8 times, medians where a third of the edges is
            turned about the vertical are 1 to 2 % worse.
        round_residuals: edges beyond a spanning tree that weigh as much as the assumption that noise is round.
    """

    iterations: int = 10
    further_iterations: int = 3
    least_ratio: float = 0.1
    least_deviation: float = float(np.radians(1e-4))
    lower_share: float = 0.25
    typical_lengths: float = 5.5
    round_residuals: float = 20.0


@dataclass(frozen=True)
class PrecisionPriors:
    """How far stated precisions are believed (``stated/precision.py``).

    Chosen before any graph with precisions was solved, after those of robots' graphs; none was tuned.

    Attributes:
        worthless: probability beforehand that stated precisions say nothing.
        num_exponents: α is one of so many numbers from 0 to 1.
        least_exponent: a mean below this is hardly more than what was known beforehand, and counts as 0.
        least_spread: of the logarithms of stated variances; where they spread by less, weights could gain 4 % of
            variance at most.
        max_log_ratio: logarithm of the factor by which an edge is believed to be better or worse than typical ones.
        max_sample: edges that tell α.
        least_residual: of the typical residual; shorter ones are of edges that the answer meets. Normal noise in three
            dimensions is as short once in a million edges.
        least_angle: rad; residuals count as at least this, numerical.
    """

    worthless: float = 0.95
    num_exponents: int = 9
    least_exponent: float = 0.1
    least_spread: float = 0.2
    max_log_ratio: float = float(np.log(100.0))
    max_sample: int = 8_000
    least_residual: float = 0.01
    least_angle: float = float(np.radians(1e-4))


@dataclass(frozen=True)
class CyclePriors:
    """What triangles say of edges (``cycles/evidence.py``).

    Attributes:
        few_paths, run: paths of two edges of a component that are looked at for a third one: so many, in runs of so
            many that begin with few edges, tell whether CleanNet knows its cameras.
        paths_per_edge, least_paths, most_paths: where it does not, so many for each edge are looked at, if that is
            between the other two.
        freedom: degrees of freedom of Student's t, the density by which triangles of good edges close.
        first_scale, scale_triangles: rad; of that density beforehand, and how many triangles tell as much.
        least_scale: rad; edges that repeat each other would have it vanish.
        base_spread, slope_spread: standard deviations beforehand of b and k, about 0.
        rounds: of messages. Means of the default with 3 and 12 were 5 and 8 % worse, when the slope was fitted always.
        full_trust: CleanNet counts in full where it explains so large a share of what triangles explain of others. On
            recipes that it was trained on it explains 0.4 to 1.1 of it, on cameras turned anyhow 0.00 to 0.03.
        by_chance: nats that may be explained by chance.
        shells: rad; densities of closing angles are constant between these.
        density_rounds: of estimating them.
    """

    few_paths: int = 40_000
    run: int = 500
    paths_per_edge: int = 2
    least_paths: int = 100_000
    most_paths: int = 400_000
    freedom: float = 3.0
    first_scale: float = float(np.radians(8.0))
    scale_triangles: float = 1.0
    least_scale: float = float(np.radians(0.3))
    base_spread: float = 3.0
    slope_spread: float = 0.5
    rounds: int = 8
    full_trust: float = 0.25
    by_chance: float = 10.0
    shells: tuple[float, ...] = tuple(
        float(np.radians(degrees)) for degrees in (0, 5, 10, 15, 20, 30, 45, 60, 90, 120, 150, 180)
    )
    density_rounds: int = 6


@dataclass(frozen=True)
class ConsensusPriors:
    """When another answer is looked for, and by which density the two are compared (``consensus/``).

    Chosen on every third scene of the four sets of scans (``docs/diary/sfm-scans.md``).

    Attributes:
        contradicting: another answer is looked for where more triangles that close have an edge that the answer rejects
            than would by chance, by so many of its standard deviations.
        closing: rad; what a triangle closes by, in steps of which other answers begin.
        glance: triangles that tell whether there may be another answer.
        max_nodes, max_edges: of a component that is looked at; larger ones would take half a minute and more.
        max_triangles: of a component, evenly spread over all that it has; so many that every edge of a complete graph
            of a hundred nodes has all of its own.
        freedom: degrees of freedom of Student's t, the density of good edges: a tenth of them err four times as much as
            typical ones.
        least_scale: rad; of that density. What registrations state they hardly know better, and without it a few edges
            that repeat each other are explained ever more exactly.
        shells: rad; false edges have any density of the angle that they state, constant in each shell between these.
            Failed registrations lie near where they began, some of them exactly there, for which the first shell is.
        shell_edges: edges that a shell of the whole sphere's volume has beforehand.
        curvature: precision of the two coefficients by which an edge's chances depend on how far its ends are turned.
        max_rounds: of expectation and maximisation.
        settled: nats by which a last round betters the likelihood at most.
        ahead: nats by which another answer has to be likelier; two rounds' rounding, where it is the same one.
    """

    contradicting: float = 5.0
    closing: tuple[float, ...] = (float(np.radians(1.0)), float(np.radians(3.0)))
    glance: int = 60_000
    max_nodes: int = 1_000
    max_edges: int = 100_000
    max_triangles: int = 200_000
    freedom: float = 3.0
    least_scale: float = float(np.radians(0.3))
    shells: tuple[float, ...] = tuple(
        float(np.radians(degrees)) for degrees in (0.0, 0.001, 5, 10, 15, 20, 30, 45, 60, 90, 120, 150, 180)
    )
    shell_edges: float = 2.0
    curvature: float = 0.1
    max_rounds: int = 100
    settled: float = 0.01
    ahead: float = 1.0


@dataclass(frozen=True)
class DensityPriors:
    """Which density of noise the last steps go by (``noise_density.py``).

    The exponents are those that an experiment on graphs of normal noise, recipes, Lund and scans compared
    (``docs/diary/sfm-refinement.md``); none of the numbers was tuned, nor how much the answer depends on them measured.

    Attributes:
        exponents: β, the first of which is that of the steps before.
        ahead: nats by which another has to be likelier.
        good_share: of the edges, to begin with.
        most_certain: one over the least share of false edges, numerical.
        rounds: of expectation and maximisation.
        least_prior: edges of less prior weight are not asked.
        max_steps: by the density; as many of all steps as are left.
    """

    exponents: tuple[float, ...] = (0.5, 0.75, 1.0, 1.5, 2.0)
    ahead: float = 10.0
    good_share: float = 0.8
    most_certain: float = 1e3
    rounds: int = 20
    least_prior: float = 1e-3
    max_steps: int = 10


@dataclass(frozen=True)
class RefinementPriors:
    """How the refinement weighs edges and when it ends (``refinement.py``).

    Standard errors are those of the answer, as a step's length λ has them (``refinement.py``). What names no other
    source was chosen on the tuning graphs.

    Attributes:
        max_steps: bound on all steps; the tuning graphs take 5–20, some scans more.
        max_coarse_steps: bound on the coarse ones; 1–4 are usual.
        telling_steps: shaped ones after which starts are compared. With none, the better start is told by the coarse
            steps, a quarter faster and 1 % worse; with twice as many, 1 % better and a fifth slower
            (``docs/diary/sfm-refinement.md``).
        same_valley: starts whose costs differ by less, of the cost, lead to one valley, but for where steps stop.
        by_a_part: how much higher the cost may be, of the cost, of a place that a part of the edges led to.
        rival_share: of a component's cameras that are turned otherwise by more than 20°: it is another place then, and
            refined, too, where a few steps do not tell. Clusters that few edges join differ by so little.
        least_shaped_steps: of few steps that a user allows, so many at least are shaped.
        coarse_smoothing: radians: shorter residuals weigh as this one in coarse steps (Chatterjee & Govindu 2013).
        coarse_settled: coarse steps end once they turn cameras by less than this share of the typical residual.
        relaxation: how many times its length a shaped step is taken. Any factor below 2 lowers the cost; 1 takes a
            third more steps, 1.7 and more alternate.
        stretched: standard errors: of steps shorter than this; longer ones are not yet in the last basin.
        held: standard errors: the noise is not estimated again after a shorter shaped step. Twice: up to 1.5 %.
        converged: standard errors: a shorter shaped step is the last. What lies ahead then is about a tenth of a
            standard error, half a per cent of the error. Twice: up to 2 %.
        converged_angle: radians: a step that turns no camera by more is the last, too; far below what orientations are
            good for.
        step_tolerance: share of a step that conjugate gradients may leave to the next step.
        least_angle: radians: the same absolutely; what single precision can tell.
        least_square: variances of the noise: floor of a residual's expected square, numerical.
        least_prior: of an edge's weight, numerical: keeps nodes attached of which all edges are rejected.
        coarse_noise: radians: where residuals are typically larger, single precision, which leaves them exact to 10⁻⁷
            rad, shows in no answer.
        least_residual: radians: floor of the typical residual, numerical.
        well_knit_degree: edges per node from which on conjugate gradients are tried without a factorisation. Half: up
            to 1.5 % on small graphs.
        max_sample: edges of a component that tell its noise; half and twice: up to 1.4 %.
        half_trusted: edges beyond a cycle with which CleanNet's log-odds count by half where they tell edges in
            series apart: it knows graphs in which many edges check each other. Orientations of the synthetic recipes,
            which have thousands, do not depend on it.
        shape: how the noise's shape is estimated.
        density: which density the last steps go by.
    """

    max_steps: int = 50
    max_coarse_steps: int = 20
    telling_steps: int = 3
    same_valley: float = 5e-3
    by_a_part: float = 0.03
    rival_share: float = 0.02
    least_shaped_steps: int = 3
    coarse_smoothing: float = float(np.radians(1.0))
    coarse_settled: float = 0.03
    relaxation: float = 1.5
    stretched: float = 1.0
    held: float = 0.3
    converged: float = 0.05
    converged_angle: float = float(np.radians(0.001))
    step_tolerance: float = 0.03
    least_angle: float = 1e-6
    least_square: float = 1e-6
    least_prior: float = 1e-6
    coarse_noise: float = 1e-3
    least_residual: float = float(np.radians(0.001))
    well_knit_degree: float = 12.0
    max_sample: int = 8_000
    half_trusted: float = 20.0
    shape: NoiseShapePriors = NoiseShapePriors()
    density: DensityPriors = DensityPriors()
