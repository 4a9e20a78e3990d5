"""Converts messages of other packages to measurements: one module per source, chosen by the type's name.

Converters only read a message's fields, so they accept rclpy's messages as well as those that `rosbags` decodes, and
import neither.
"""

from rotavg_ros.inputs.records import (
    EdgeConverter,
    EdgeRecord,
    EdgeVerdict,
    OdometryConverter,
    OdometryRecord,
    Source,
    WholeGraphConverter,
)
from rotavg_ros.inputs.registry import (
    BRINGS_KEYFRAMES,
    EDGE_CONVERTERS,
    FRAMELESS_ODOMETRY,
    NAMES_ITS_BODY,
    ODOMETRY_CONVERTERS,
    OF_ONE_ROBOT,
    WITHOUT_CLOSURES,
)

__all__ = [
    "BRINGS_KEYFRAMES",
    "EDGE_CONVERTERS",
    "FRAMELESS_ODOMETRY",
    "NAMES_ITS_BODY",
    "ODOMETRY_CONVERTERS",
    "OF_ONE_ROBOT",
    "WITHOUT_CLOSURES",
    "EdgeConverter",
    "EdgeRecord",
    "EdgeVerdict",
    "OdometryConverter",
    "OdometryRecord",
    "Source",
    "WholeGraphConverter",
]
