"""Errors of positions are evo's, alignment included."""

from __future__ import annotations

import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics import fit_onto, position_errors


@pytest.mark.parametrize("flat", [False, True])
def test_errors_are_evos(flat: bool) -> None:
    rng = np.random.default_rng(0)
    reference = np.cumsum(rng.normal(size=(80, 3)), axis=0) * [1, 1, not flat]
    noisy = reference + rng.normal(scale=0.2, size=(80, 3))
    position = Rotation.from_rotvec([0.0, 0.0, 2.0]).apply(noisy) + np.array([5.0, -3.0, 1.0])
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (80, 1))
    estimate = PosePath3D(position, identity)
    estimate.align(PosePath3D(reference, identity))
    metric = APE(PoseRelation.translation_part)
    metric.process_data((PosePath3D(reference, identity), estimate))
    np.testing.assert_allclose(position_errors(position, reference), metric.error, atol=1e-9)


def test_unknown_positions_stay_unknown() -> None:
    reference = np.random.default_rng(1).normal(size=(10, 3))
    position = reference + np.array([1.0, 2.0, 3.0])
    position[4] = np.nan
    errors = position_errors(position, reference)
    assert np.flatnonzero(np.isnan(errors)).tolist() == [4]
    np.testing.assert_allclose(np.delete(errors, 4), 0, atol=1e-12)
    assert fit_onto(np.zeros((1, 3)), np.zeros((1, 3))) is None
    assert np.isnan(position_errors(np.zeros((1, 3)), np.zeros((1, 3)))).all()
