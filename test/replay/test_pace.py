"""When a replay ticks."""

from __future__ import annotations

import itertools

from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.replay.pace import Pace, WorkRates

RATES = WorkRates(bare=1.0, at_first=10_000, per_second=1000)
TICKS = st.lists(st.tuples(st.integers(1, 20_000), st.floats(0, 3000)), min_size=1, max_size=200)


def play(pace: Pace, ticks: list[tuple[int, float]]) -> list[float | None]:
    """Units that were spent at each strike; None where there was no tick."""
    spent: list[float | None] = []
    for size, work in ticks:
        if not pace.strikes():
            spent.append(None)
            continue
        pace.spend(size, work)
        spent.append(size + work)
    return spent


@given(sizes=TICKS)
def test_no_more_is_spent_than_may_be_but_for_the_last_tick(sizes: list[tuple[int, float]]) -> None:
    spent = play(Pace(0.5, RATES), sizes)
    for strikes in range(1, len(spent) + 1):
        units = [each for each in spent[:strikes] if each is not None]
        before_last = sum(units[:-1])
        assert before_last <= RATES.at_first + RATES.per_second * 0.5 * strikes + 1e-6


@given(sizes=st.lists(st.integers(1, 500), max_size=100))
def test_a_small_graph_ticks_at_every_strike(sizes: list[int]) -> None:
    """500 units come with every half second."""
    assert None not in play(Pace(0.5, RATES), [(size, 0) for size in sizes])


@given(sizes=TICKS)
def test_where_the_user_has_said_how_often_every_strike_is_a_tick(sizes: list[tuple[int, float]]) -> None:
    assert None not in play(Pace(0.5, None), sizes)
    assert "units of work a second, about 0.5 ms each" in Pace(0.5, RATES).told()
    assert "every 0.5 s" in Pace(0.5, None).told() and "units" not in Pace(0.5, None).told()


def test_a_large_graph_ticks_on() -> None:
    """Each tick is paid off in time: 20 000 at 1000 a second are 20 s, or 40 strikes."""
    spent = play(Pace(0.5, RATES), [(20_000, 0)] * 400)
    at = [strike for strike, each in enumerate(spent) if each is not None]
    assert at[0] == 0 and {later - earlier for earlier, later in itertools.pairwise(at[1:])} == {40}
