"""A bag in every form that recorders write: storages, compressions, generations of ROS, foreign packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rotavg_ros.bags.message_types import definitions_folder, typestore
from rotavg_ros.bags.reader import BagReader

INTERFACES = Path(__file__).parent.parent / "interfaces"


def rosbag2(storage: StoragePlugin, mode: CompressionMode) -> Callable[[Path, Path], Path]:
    """What copies a bag into that form of rosbag2."""

    def copy(bag: Path, folder: Path) -> Path:
        writer = Writer(folder / "copy", version=9, storage_plugin=storage)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer, BagReader(bag) as reader:
            connections = {
                topic: writer.add_connection(topic, kind, typestore=typestore())
                for topic, kind in reader.topics.items()
            }
            for message in reader.messages():
                writer.write(connections[message.topic], message.time_ns, message.data)
        return folder / "copy"

    return copy


def single_file(bag: Path, folder: Path) -> Path:
    """The recording alone, without its metadata."""
    (recording,) = bag.glob("*.mcap")
    alone = folder / "alone.mcap"
    alone.write_bytes(recording.read_bytes())
    return alone


def rosbag1(bag: Path, folder: Path) -> Path:
    """A ROS 1 bag, its chunks compressed with lz4."""
    store = ros1_typestore()
    writer = Rosbag1Writer(folder / "old.bag")
    writer.set_compression(Rosbag1Writer.CompressionFormat.LZ4)
    with writer, BagReader(bag) as reader:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in reader.topics.items()
        }
        for message in reader.messages():
            data = typestore().cdr_to_ros1(message.data, message.message_type)
            writer.write(connections[message.topic], message.time_ns, data)
    return folder / "old.bag"


def ros1_typestore() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    for path in sorted(definitions_folder().glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(encoding="utf-8"), f"rotavg_msgs/msg/{path.stem}"))
    return store


def foreign_typestore(package: str, replacements: Mapping[str, str] | None = None) -> Typestore:
    """ROS 2's messages and those of a package that is not installed, another version of it after replacements."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted((INTERFACES / package / "msg").glob("*.msg")):
        text = path.read_text(encoding="utf-8")
        for old, new in (replacements or {}).items():
            text = text.replace(old, new)
        store.register(get_types_from_msg(text, f"{package}/msg/{path.stem}"))
    return store


FORMS: dict[str, Callable[[Path, Path], Path]] = {
    "sqlite3": rosbag2(StoragePlugin.SQLITE3, CompressionMode.NONE),
    "sqlite3, messages by zstd": rosbag2(StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "sqlite3, file by zstd": rosbag2(StoragePlugin.SQLITE3, CompressionMode.FILE),
    "mcap, chunks by zstd": rosbag2(StoragePlugin.MCAP, CompressionMode.STORAGE),
    "mcap, file by zstd": rosbag2(StoragePlugin.MCAP, CompressionMode.FILE),
    "one mcap file": single_file,
    "ROS 1": rosbag1,
}
