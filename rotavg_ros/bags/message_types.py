"""ROS 2's standard message types and the project's own, as `rosbags` knows them.

The ``.msg`` files of ``rotavg_msgs`` are the only definition of the project's messages; they are parsed where they are:
in the source tree, or in ``share/rotavg_ros`` of the place into which pip or colcon installed the package.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rotavg_ros.errors import UserError

ODOMETRY = "nav_msgs/msg/Odometry"
RELATIVE_ROTATION = "rotavg_msgs/msg/RelativeRotation"
RELATIVE_ROTATION_ARRAY = "rotavg_msgs/msg/RelativeRotationArray"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


class MessageTypeError(UserError):
    """The project's message definitions are not where an installation puts them."""


@cache
def typestore() -> Typestore:
    """All message types that we write (ROS 2 Jazzy's and ``rotavg_msgs``).

    Raises:
        MessageTypeError: the ``.msg`` files were not installed.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in sorted(definitions_folder().glob("*.msg")):
        types.update(get_types_from_msg(path.read_text(encoding="utf-8"), f"rotavg_msgs/msg/{path.stem}"))
    store.register(types)
    return store


def definitions_folder() -> Path:
    """The folder of the project's ``.msg`` files."""
    here = Path(__file__).resolve()
    candidates = [here.parents[2] / "msg_defs" / "msg"]
    candidates += [ancestor / "share" / "rotavg_ros" / "msg" for ancestor in here.parents]
    for folder in candidates:
        if any(folder.glob("*.msg")):
            return folder
    raise MessageTypeError(
        "the message definitions share/rotavg_ros/msg/*.msg are missing from the installation; install rotavg_ros again"
    )
