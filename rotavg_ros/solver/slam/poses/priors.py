"""What is believed of translations before a graph is seen, in one frozen class; beside ``posterior/priors.py``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlacePriors:
    """Lengths are in typical steps of odometry, the median of those that go anywhere, so that no unit matters.

    Attributes:
        step: median of the standard deviation of where one typical step of odometry ends, per component; its variance
            grows with the way passed.
        step_spread: standard deviation of its logarithm: small, since odometry that may err by anything makes room for
            every false closure; …
        largest_step: … and what it is at most, where everything is at one place.
        closure: median of the standard deviation of a good closure's translation, …
        closure_spread: … and that of its logarithm.
        relative: median of what a good closure's translation errs by, of its own length, …
        relative_spread: … and standard deviation of its logarithm: most front ends measure lengths, some guess them.
        slip: standard deviation of how far a step is off by where it slipped, beside what its turn bends.
        common: share of a closure's variance that it has in common with those near it, in the median; …
        common_spread: … standard deviation of the logarithm of what they share over what they do not; …
        most_common: … and the largest share.
        tails: share of good closures whose translation errs by far more than others', …
        tail_ratio: … by so many times the variance.
        turned_deg: standard deviation of how much another place that looks alike is seen turned.
        from_behind: share of places that look alike that do so from the other side, half a turn off.
        turned_in_place: share of false rotations at the right place: symmetric rooms, registrations that flip.
        elsewhere: share of wrong places that are off as others far from them are, by the same turn of the map or the
            same shift, where there are such: a priori that many of as many as are counted beforehand.
        wrong_place: closures of a plausible rotation that join wrong places: a priori that many in as many as are
            counted beforehand, …
        counted: … in all, as for the shares of those that repeat others; what all tell counts for one closure within
            a run.
        repeats: share of wrong places that repeat the one of the closure before or after, where there is one: likewise.
        least_wrong: a wrong place is off by so many standard deviations of a good closure at least, and by the map's
            extent at most; all scales between are as likely.
    """

    step: float = 0.05
    step_spread: float = 0.7
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
