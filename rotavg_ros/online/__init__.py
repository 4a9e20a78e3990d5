"""The online estimator: odometry and edges in, ticks, absolute orientations and outlier flags out. No ROS, no clock."""

from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.estimator import OnlineEstimator
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference, RejectReason
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.state.discarded import Discarded

__all__ = [
    "Answer",
    "Discarded",
    "EdgeMeasurement",
    "EstimatorOptions",
    "KeyframeReference",
    "OnlineEstimator",
    "RejectReason",
]
