from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.online.answer.trajectory import dead_reckoning


def test_a_square_that_odometry_bends_is_square_again():
    true_heading = np.radians([0, 90, 180, 270, 0])
    steps = np.stack((np.cos(true_heading), np.sin(true_heading), 0 * true_heading), axis=1)[:-1]
    truth = np.vstack((np.zeros(3), np.cumsum(steps, axis=0)))
    bent_heading = true_heading + np.radians([0, 5, 10, 15, 20])
    bent_steps = np.stack((np.cos(bent_heading), np.sin(bent_heading), 0 * bent_heading), axis=1)[:-1]
    bent = np.vstack((np.zeros(3), np.cumsum(bent_steps, axis=0)))
    corrected = dead_reckoning(
        Rotation.from_euler("z", true_heading[:, None]).as_quat(),
        Rotation.from_euler("z", bent_heading[:, None]).as_quat(),
        bent,
    )
    np.testing.assert_allclose(corrected, truth, atol=1e-12)


def test_positions_that_are_not_known_stay_unknown():
    orientation = np.tile([0, 0, 0, 1.0], (3, 1))
    assert np.isnan(dead_reckoning(orientation, orientation, np.full((3, 3), np.nan))).all()
    assert len(dead_reckoning(orientation[:1], orientation[:1], np.zeros((1, 3)))) == 1
