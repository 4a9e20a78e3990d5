"""The online estimator: odometry and edges in, ticks, absolute orientations and outlier flags out. No ROS, no clock."""

from rotavg_ros.online.answer import Answer
from rotavg_ros.online.estimator import Discarded, OnlineEstimator
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference, RejectReason
from rotavg_ros.online.options import EstimatorOptions

__all__ = [
    "Answer",
    "Discarded",
    "EdgeMeasurement",
    "EstimatorOptions",
    "KeyframeReference",
    "OnlineEstimator",
    "RejectReason",
]
