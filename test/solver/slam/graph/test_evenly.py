"""Some of many, evenly spread."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.solver.slam.graph.evenly import evenly


@given(st.integers(0, 500), st.integers(2, 60))
def test_as_many_as_fit_from_the_first_to_the_last(count: int, most: int) -> None:
    values = 7 * np.arange(count)
    found = evenly(values, most)
    assert len(found) == min(count, most) == len(np.unique(found))
    assert np.isin(found, values).all()
    if count:
        assert found[0] == values[0] and found[-1] == values[-1]
        steps = np.diff(found)
        assert not len(steps) or steps.max() - steps.min() <= 7
