"""Corrections that are spread over time: never faster than allowed, and there in the end."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import quaternion
from rotavg_ros.online.answer.gradual import CorrectionRates, GradualFrame
from rotavg_ros.online.answer.odometry_frame import OdometryFrame

SECOND = 1_000_000_000
PERIOD_S = 0.1


def frame(turn: tuple[float, float, float], origin: tuple[float, float, float], chain: int = 0) -> OdometryFrame:
    x, y, z, w = Rotation.from_rotvec(turn).as_quat(canonical=True).tolist()
    return OdometryFrame(chain, (x, y, z, w), origin, (0.0, 0.0, 0.0))


vectors = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
far = st.tuples(*[st.floats(-1000.0, 1000.0)] * 3)
BEFORE = frame((0, 0, 0), (0, 0, 0))


@given(turn=vectors, origin=vectors, at=far, rates=st.tuples(st.floats(0.01, 1.0), st.floats(0.1, 10.0)))
@settings(max_examples=100, deadline=None)
def test_the_body_turns_and_moves_no_faster_than_allowed_until_it_is_there(turn, origin, at, rates):
    wanted, gradual = frame(turn, origin), GradualFrame(CorrectionRates(*rates))
    last = gradual.follow(BEFORE, 0, at)
    needed = [math.dist(last.place(at), wanted.place(at)) / rates[1]]
    needed.append(quaternion.angle_between(last.orientation, wanted.orientation) / rates[0])
    ticks = math.ceil(max(needed) / PERIOD_S) + 1
    for tick in range(1, min(ticks, 50) + 1):
        now = gradual.follow(wanted, round(tick * PERIOD_S * SECOND), at)
        assert math.dist(now.place(at), last.place(at)) <= rates[1] * PERIOD_S * 1.001 + 1e-9
        assert quaternion.angle_between(now.orientation, last.orientation) <= rates[0] * PERIOD_S * 1.001 + 1e-7
        last = now
    if ticks <= 50:
        assert last == wanted


@pytest.mark.parametrize("rates", [CorrectionRates(), CorrectionRates(turn=0.1), CorrectionRates(way=0.1)])
def test_what_has_no_limit_is_done_at_once(rates):
    at, wanted, gradual = (3.0, 4.0, 0.0), frame((0, 0, 1.0), (1.0, 2.0, 0.0)), GradualFrame(rates)
    gradual.follow(BEFORE, 0, at)
    now = gradual.follow(wanted, SECOND // 10, at)
    is_there = math.dist(now.place(at), wanted.place(at)) < 1e-9
    is_turned = quaternion.angle_between(now.orientation, wanted.orientation) < 1e-9
    assert (is_there, is_turned) == (rates.way == 0, rates.turn == 0)


def test_odometry_s_own_motion_is_not_held_back():
    gradual = GradualFrame(CorrectionRates(0.01, 0.01))
    for index in range(20):
        at = (5.0 * index, 0.0, 0.0)
        np.testing.assert_allclose(gradual.follow(BEFORE, index * SECOND, at).place(at), at)


@pytest.mark.parametrize(("chain", "stamp_ns"), [(1, SECOND), (0, 0), (0, -SECOND)])
def test_there_is_nothing_to_go_on_from_where_odometry_or_time_begins_anew(chain, stamp_ns):
    gradual, wanted = GradualFrame(CorrectionRates(0.01, 0.01)), frame((0, 0, 1.0), (1.0, 2.0, 0.0), chain)
    gradual.follow(BEFORE, 0, (0.0, 0.0, 0.0))
    assert gradual.follow(wanted, stamp_ns, (0.0, 0.0, 0.0)) == wanted
