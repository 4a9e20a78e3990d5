"""What a state file says of odometry's way between keyframes that are gone is checked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.online.state import file as state_file
from rotavg_ros.online.state.file import Arrays, StateFileError

OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, max_turn_rate=0, max_speed=0, max_keyframes=60)


@pytest.fixture
def arrays(tmp_path: Path) -> Arrays:
    """Of a graph from which keyframes were taken out."""
    estimator = OnlineEstimator(OPTIONS)
    for index in range(200):
        turn = Rotation.from_euler("z", 0.05 * index).as_quat().tolist()
        estimator.add_odometry("r", index * 10**9, turn, np.array([0.5 * index, 0.0, 0.0]))
    assert estimator.counts().marginalized > 100
    estimator.save(tmp_path / "state")
    return dict(state_file.read(tmp_path / "state"))


def loaded(arrays: Arrays, path: Path) -> OnlineEstimator:
    state_file.write(path, arrays)
    estimator = OnlineEstimator(OPTIONS)
    estimator.load(path)
    return estimator


def test_they_come_back_as_they_were_and_may_be_missing(arrays: Arrays, tmp_path: Path) -> None:
    graph = loaded(arrays, tmp_path / "again").snapshot().graph
    np.testing.assert_array_equal(graph.route, arrays["route"])
    np.testing.assert_array_equal(graph.routes, arrays["routes"])
    without = {name: values for name, values in arrays.items() if name not in {"route", "routes"}}
    estimator = loaded(without, tmp_path / "without")
    assert estimator.snapshot().graph.route is None
    assert np.isfinite(estimator.tick(force_cold=True).world_from_body).all()


@pytest.mark.parametrize(
    ("name", "damaged"),
    [
        ("route", lambda values: values[:-1]),
        ("route", lambda values: values + 99),
        ("route", lambda values: np.stack((values, values), axis=1)),
        ("routes", lambda values: values[:, 0]),
        ("routes", lambda values: values.astype(str)),
        ("routes", lambda values: np.full_like(values, np.inf)),
        ("routes", lambda values: values[:0]),
    ],
)
def test_others_are_refused(
    name: str, damaged: Callable[[np.ndarray], np.ndarray], arrays: Arrays, tmp_path: Path
) -> None:
    with pytest.raises(StateFileError, match="content is inconsistent"):
        loaded(arrays | {name: damaged(arrays[name])}, tmp_path / "damaged")
