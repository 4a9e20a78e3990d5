"""Every number that the posterior believes beforehand, and every bound of its search, in two frozen classes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SlamPriors:
    """What is believed of a robot's graph before it is seen. Angles are in degrees, per component of a rotation.

    Rates that are not named here (the share of repeated turns, the stickiness of labels) are integrated over a grid,
    see :mod:`rotavg_ros.solver.slam.posterior.labels`.

    Attributes:
        step_deg: median of the standard deviation of one step of odometry.
        closure_deg: the same of a good closure; and the standard deviation of how their sensor is said to be mounted.
        noise_spread: standard deviation of the logarithm of both.
        tails: probability that some of the sound segments err by far more than others; and that good closures do;
            all shares that are summed over are as likely (:mod:`rotavg_ros.solver.slam.posterior.state`), …
        tail_ratio: … and these have so many times the variance (Huber's contaminated normal).
        outlier_share: mean of the Beta prior of the share of false closures, …
        outlier_count: … and how many closures it counts for.
        near_miss_share: mean of the Beta(1, ·) prior of the share of false closures wrong by a normal turn, or by
            such a turn more than half a turn, …
        near_miss_deg: … of this standard deviation; the others are wrong by any turn.
        elsewhere_count: the share of false closures that repeat the wrong turn of others elsewhere on the path has the
            prior Beta(1, elsewhere_count); that of repeats nearby, uniform.
        slip_count: the share of slipping steps has the prior Beta(slip_count, slip_steps), …
        slip_steps: … so the first slip is dear and later ones are cheaper.
        slip_deg: standard deviation of what a step is off by where it slipped.
        bias_deg: standard deviation of a component of a gyroscope's bias, per step.
        run_gap_steps: closures follow each other in a run if their ends are at most so many steps of odometry apart,
            both ends summed, …
        common_errors: probability that closures of a run err alike; for how long and how far, all values that are
            summed over are as likely (:mod:`rotavg_ros.solver.slam.posterior.state`).
        turn_errors: probability that odometry errs more where it turns; all shares that are summed over are as likely.
        stated_share: probability that stated variances say anything.
        least_stated_ratio: no closure is believed to be more exact than this share of the typical variance.
        largest_stated_ratio: a stated variance farther from the typical one than by this factor says nothing.
    """

    step_deg: float = 0.3
    closure_deg: float = 2.0
    noise_spread: float = 0.7
    tails: float = 0.5
    tail_ratio: float = 16.0
    outlier_share: float = 0.25
    outlier_count: float = 4.0
    near_miss_share: float = 0.5
    near_miss_deg: float = 20.0
    elsewhere_count: float = 10.0
    slip_count: float = 1.0
    slip_steps: float = 20000.0
    slip_deg: float = 45.0
    bias_deg: float = 1.0
    run_gap_steps: float = 30.0
    common_errors: float = 0.5
    turn_errors: float = 0.5
    stated_share: float = 0.5
    least_stated_ratio: float = 0.25
    largest_stated_ratio: float = 100.0


@dataclass(frozen=True)
class SearchLimits:
    """How far the search goes; none of them says what is likelier.

    Attributes:
        polish_solves: sparse solves at most to bring a labelling to its optimum.
        trial_solves: the same while other noise is tried, or flips of single labels.
        settling_solves: the same while labels are probabilities.
        converged: what lowers F by less than so many nats, a step or other noise, is no movement.
        flip_rounds: batches of single flips.
        annealing_factor: by how much the loss of graduated non-convexity is sharpened from solve to solve.
        robust_solves: of the ℓ½ start.
        alike: starts are gone on from until so many end in the mode of least F.
        tried: moves that are tried, at most.
        slack: a move is tried if F is predicted to rise by no more than this, nats.
        rival: modes within so many nats of the best are moved on from.
        slips: places for a slip that are looked at.
        window: false closures before (and after) one that it is compared with.
        averaged: labellings that are averaged, at most.
    """

    polish_solves: int = 20
    trial_solves: int = 5
    settling_solves: int = 8
    converged: float = 0.03
    flip_rounds: int = 8
    annealing_factor: float = 1.6
    robust_solves: int = 12
    alike: int = 3
    tried: int = 60
    slack: float = 1.0
    rival: float = 6.0
    slips: int = 12
    window: int = 48
    averaged: int = 8
