"""All prior parameters of translations, in one frozen class; those of rotations are in ``posterior/priors.py``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlacePriors:
    """Prior parameters of translations.

    Lengths are in typical steps of odometry (the median of those not on the spot), so the unit does not matter.

    Attributes:
        step: median of the standard deviation of the end of one typical step of odometry, per component; the variance
            grows with the distance travelled.
        step_spread: standard deviation of its logarithm: small, since odometry with arbitrary errors would be
            compatible with every false closure.
        still: median of the standard deviation of the end of any step, however short, per component; that variance is
            added.
        still_spread: standard deviation of its logarithm.
        largest_step: upper bound of both standard deviations, for when everything is at one place.
        closure: median of the standard deviation of a good closure's translation.
        closure_spread: standard deviation of its logarithm.
        relative: median of a good closure's translation error relative to its length.
        relative_spread: standard deviation of its logarithm: most front ends measure lengths, some guess them.
        slip: standard deviation of the position error of a step that slipped, beyond the effect of its turn.
        common: median share of a closure's variance that it has in common with those near it.
        common_spread: standard deviation of the logarithm of the shared over the unshared variance.
        most_common: largest common share.
        tails: share of good closures whose translation errs by far more than others'; fewer where fewer show.
        tail_ratio: factor of the variance of these.
        turned_deg: standard deviation of the turn between the views of two places that look alike.
        from_behind: share of places that look alike when seen from the other side, half a turn off.
        turned_in_place: share of false rotations at the right place: symmetric rooms, registrations that flip.
        elsewhere: prior share, with ``counted`` as its weight, of wrong places with the same displacement as others far
            from them, by the same turn of the map or the same shift, where there are such.
        wrong_place: prior number, out of ``counted``, of closures with a plausible rotation that join wrong places.
        counted: number of closures for which these priors count, also for the shares of repeats; within a run, the
            evidence of all others counts as one closure.
        repeats: prior share, likewise, of wrong places that repeat that of the closure before or after, if there is
            one.
        least_wrong: least error of a wrong place, in standard deviations of a good closure; the largest is the map's
            extent. All scales in between are equally likely.
    """

    step: float = 0.05
    step_spread: float = 0.7
    still: float = 0.01
    still_spread: float = 1.0
    largest_step: float = 0.3
    closure: float = 1.0
    closure_spread: float = 1.0
    relative: float = 0.05
    relative_spread: float = 1.5
    slip: float = 1.0
    common: float = 0.5
    common_spread: float = 1.0
    most_common: float = 0.85
    tails: float = 0.1
    tail_ratio: float = 16.0
    turned_deg: float = 10.0
    from_behind: float = 0.5
    turned_in_place: float = 0.5
    elsewhere: float = 0.5
    wrong_place: float = 0.5
    counted: float = 3.0
    repeats: float = 0.7
    least_wrong: float = 4.0
