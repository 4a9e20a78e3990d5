"""Odometry messages that are read while others come."""

from __future__ import annotations

import numpy as np

from rotavg_ros.online.odometry.continuity import OdometrySample
from rotavg_ros.online.odometry.samples import OdometryBounds, OdometrySamples


def test_what_is_frozen_stays_though_messages_come_and_old_ones_are_thinned_out() -> None:
    samples = OdometrySamples(OdometryBounds(tolerance_ns=5, max_gap_ns=100, max_samples=100))

    def add(first: int, last: int) -> None:
        for stamp in range(first, last):
            turn = (0.0, 0.0, float(np.sin(stamp)), float(np.cos(stamp)))
            samples.append(OdometrySample(stamp, turn, (float(stamp), 0.0, 0.0)), 0, 0)

    add(0, 100)
    frozen, stamps = samples.frozen(), np.arange(100)
    before = frozen.poses_at(stamps, np.zeros(100, dtype=np.int64))
    add(100, 1000)
    assert len(samples) < 1000 and len(frozen) == 100
    for was, now in zip(before, frozen.poses_at(stamps, np.zeros(100, dtype=np.int64)), strict=True):
        np.testing.assert_array_equal(was, now)
    np.testing.assert_array_equal(before[1][:, 0], stamps)
