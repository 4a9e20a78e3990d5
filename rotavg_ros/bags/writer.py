"""Writing rosbag2 folders: MCAP, complete or absent."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from rotavg_ros.bags import bulk
from rotavg_ros.bags.message_types import typestore
from rotavg_ros.bags.reader import COMPRESSED_SUFFIX
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.whole_file import real

_METADATA = "metadata.yaml"
# How the names of a recorder's other files end; sqlite keeps two beside a database that is being written.
_OF_RECORDER = (".mcap", ".db3", ".db3-wal", ".db3-shm", COMPRESSED_SUFFIX)
_UNLIMITED = QosTime(2147483647, 4294967295)


class BagWriteError(UserError):
    """A bag that cannot be written; the message names the folder and what to do."""


class BagWriter:
    """An unfinished rosbag2 folder; it gets its name when the ``with`` block ends without an error.

    Args:
        path: the bag's folder, which must not exist.
        overwrite: replace an existing bag (only a folder that is a bag and nothing else, or an empty one).
        compressed: whether to compress chunks with zstd.

    Raises:
        BagWriteError: the folder exists, or its place cannot be written.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False, compressed: bool = False) -> None:
        self._path = Path(path)
        self._compressed = compressed
        self._overwrite = overwrite
        self._place = real(self._path)
        # The bag grows inside a hidden folder beside its place, since a recording is named after its own folder.
        self._workplace = self._place.parent / f".{self._place.name}.unfinished"
        self._writer: Writer | None = None
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        refuse_existing(self._path, overwrite=self._overwrite)
        try:
            shutil.rmtree(self._workplace, ignore_errors=True)
            self._writer = Writer(self._workplace / self._place.name, version=8, storage_plugin=StoragePlugin.MCAP)
            if self._compressed:
                self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except OSError as error:
            raise self._cannot_write(error) from None
        return self

    def add_topic(self, topic: str, message_type: str, *, latched: bool = False) -> None:
        """Declare a topic; written with reliable QoS, transient_local where ``latched``."""
        assert self._writer is not None
        qos = Qos(
            history=QosHistory.KEEP_LAST,
            depth=1 if latched else 100,
            reliability=QosReliability.RELIABLE,
            durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
            deadline=_UNLIMITED,
            lifespan=_UNLIMITED,
            liveliness=QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=_UNLIMITED,
            avoid_ros_namespace_conventions=False,
        )
        self._connections[topic] = self._writer.add_connection(
            topic, message_type, typestore=typestore(), offered_qos_profiles=[qos]
        )

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Append a message to a declared topic; messages should come in the order of their stamps."""
        connection = self._connections[topic]
        self.write_raw(topic, stamp_ns, typestore().serialize_cdr(message, connection.msgtype))

    def write_bulk(self, topic: str, stamp_ns: int, message: Any) -> None:
        """As :meth:`write`, for a message with sequences in bulk (:mod:`rotavg_ros.bags.bulk`)."""
        self.write_raw(topic, stamp_ns, bulk.serialize(message, self._connections[topic].msgtype))

    def write_raw(self, topic: str, stamp_ns: int, cdr: bytes | memoryview) -> None:
        """Append a message that is already serialised."""
        assert self._writer is not None
        try:
            self._writer.write(self._connections[topic], int(stamp_ns), cdr)
        except OSError as error:
            raise self._cannot_write(error) from None

    def set_note(self, key: str, value: str) -> None:
        """Write a line of the bag's own metadata (``custom_data``)."""
        assert self._writer is not None
        self._writer.set_custom_data(key, value)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._writer is not None
        try:
            if error is None:
                self._writer.close()
                self._take_place()
        except OSError as failure:
            raise self._cannot_write(failure) from None
        finally:
            if error is not None:
                with suppress(Exception):
                    self._writer.abort()
            shutil.rmtree(self._workplace, ignore_errors=True)

    def _take_place(self) -> None:
        if self._place.exists():
            shutil.rmtree(self._place)
        (self._workplace / self._place.name).rename(self._place)

    def _cannot_write(self, error: OSError) -> BagWriteError:
        return BagWriteError(f"{self._path}: cannot be written: {error.strerror or error}")


def refuse_existing(path: Path, *, overwrite: bool) -> None:
    """Refuse to replace a bag without ``overwrite``, and in any case what is not a bag, or a bag with others' files.

    Raises:
        BagWriteError: something is at the bag's place.
    """
    with asking_about(path, BagWriteError):
        exists = path.exists()
        content = sorted(path.iterdir()) if path.is_dir() else []
        may_go = path.is_dir() and _is_bag_or_empty(content)
        others = [each.name for each in content if not _is_of_bag(each)]
        is_here = may_go and real(path) in (Path.cwd(), *Path.cwd().parents)
    if not exists:
        return
    if not overwrite:
        raise BagWriteError(f"{path}: exists already; choose another --output or give --overwrite")
    if not may_go:
        raise BagWriteError(f"{path}: is not a bag, so --overwrite leaves it alone; choose another --output")
    if others:
        raise BagWriteError(
            f"{path}: holds {others[0]} as well, which is not the bag's and would be deleted; move it away or choose "
            "another --output"
        )
    if is_here:
        raise BagWriteError(f"{path}: is the folder you are in, so it cannot be replaced; choose another --output")


def _is_bag_or_empty(content: Sequence[Path]) -> bool:
    return not content or any(path.name == _METADATA for path in content)


def _is_of_bag(path: Path) -> bool:
    """Whether a file in a bag's folder is the recorder's; a folder counts if it is empty."""
    if path.is_dir() and not path.is_symlink():
        return not any(path.iterdir())
    return path.name == _METADATA or path.name.endswith(_OF_RECORDER)
