"""How accurate an answer is: errors of orientations and positions, verdicts on edges, and scores as probabilities.

Training, evaluation, replay and reports all use them. Where evo defines a metric, ours is the same, and a test
compares the two: the absolute rotation error (evo's APE, rotation angle, of aligned orientations), the relative one
(RPE, rotation angle: :func:`true_edge_noise` of the estimate's own steps) and the position error after alignment (APE,
translation part, after evo's ``align``; its root mean square is the ATE). evo is only used in tests, since it is not a
dependency on a robot, whose replays are also compared with a reference. It defines no alignment of orientations by
themselves; :func:`gauge_alignment` is the paper's.
"""

from rotavg_ros.metrics.calibration import CalibrationBins, expected_calibration_error
from rotavg_ros.metrics.orientations import body_from_world, gauge_alignment, orientation_errors, true_edge_noise
from rotavg_ros.metrics.positions import RigidFit, fit_onto, fits_onto, known_rows, position_errors
from rotavg_ros.metrics.verdicts import OutlierCounts, roc_area

__all__ = [
    "CalibrationBins",
    "OutlierCounts",
    "RigidFit",
    "body_from_world",
    "expected_calibration_error",
    "fit_onto",
    "fits_onto",
    "gauge_alignment",
    "known_rows",
    "orientation_errors",
    "position_errors",
    "roc_area",
    "true_edge_noise",
]
