"""What is published of rival labellings."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.slam.posterior.publishing.modes import median


@given(seed=st.integers(0, 10_000), rivals=st.integers(1, 5))
def test_the_median_has_the_least_expected_angle(seed: int, rivals: int) -> None:
    random = np.random.default_rng(seed)
    orientations = [Rotation.random(7, random_state=random.integers(1 << 30)) for _ in range(rivals)]
    share = random.dirichlet(np.ones(rivals))
    expected = [
        sum(weight * (one.inv() * other).magnitude().mean() for weight, other in zip(share, orientations, strict=True))
        for one in orientations
    ]
    chosen = median([rotation.as_quat().T for rotation in orientations], share)
    assert expected[chosen] == pytest.approx(min(expected))


def test_what_is_likelier_than_not_is_published_as_it_is() -> None:
    folded = Rotation.from_rotvec([[0.0, 0.0, angle] for angle in (0.0, 3.0, 3.0)])
    straight = Rotation.from_rotvec(np.zeros((3, 3)))
    assert median([folded.as_quat().T, straight.as_quat().T], np.array([0.45, 0.55])) == 1
