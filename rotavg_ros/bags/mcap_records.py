"""Reads records of MCAP files that may be damaged: the sound ones, and whether these are all."""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BytesIO
from typing import IO, Any, cast

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import get_chunk_data_stream

# Errors that mcap raises for invalid content.
NONSENSE = (McapError, ValueError, struct.error, MemoryError)
# Opcode and length before every record.
_RECORD_HEAD = struct.Struct("<BQ")

Block = list[Schema | Channel | Message]


class Exact:
    """A file that raises an error if more is requested than it has left, before anything is read into memory."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left = file, size

    def read(self, length: int) -> bytes:
        self._left -= length
        if self._left < 0:
            raise EndOfFile
        return self._file.read(length)


def summary_of(file: IO[bytes]) -> Any:
    """The index at the end of the file; None if it is missing, or does not list chunks."""
    try:
        file.seek(0)
        summary = SeekingReader(file).get_summary()
    except Exception:  # whatever garbled bytes make the reader stumble over
        return None
    return summary if summary is not None and summary.chunk_indexes else None


def record_head_of(file: IO[bytes]) -> int:
    """Opcode of the record that begins here, 0 if the file ends before; the file is read up to the record's content."""
    head = file.read(_RECORD_HEAD.size)
    return head[0] if len(head) == _RECORD_HEAD.size else 0


def whole(chunk: Chunk) -> bytes:
    """A chunk's content, which must match its checksum if it has one."""
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(length)


def begun(chunk: Chunk) -> bytes:
    """The beginning of an incomplete chunk's content, as far as it can be decompressed."""
    if chunk.compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(chunk.data)
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data))
    return chunk.data


def parsed(chunk: Chunk, content_of: Callable[[Chunk], bytes]) -> tuple[Block, bool]:
    """A chunk's records, and whether these are all."""
    records: Block = []
    try:
        content = content_of(chunk)
        at = 0
        while at < len(content):
            opcode, length = _RECORD_HEAD.unpack_from(content, at)
            body = content[at + _RECORD_HEAD.size : at + _RECORD_HEAD.size + length]
            if len(body) < length:
                return records, False
            at += _RECORD_HEAD.size + length
            record = _record(opcode, body)
            if isinstance(record, Message) and not _is_of(record, chunk):
                return records, False
            records.append(record)
    except Exception:  # whatever garbled bytes make the decoders stumble over
        return records, False
    return records, True


def _record(opcode: int, body: bytes) -> Schema | Channel | Message:
    """A record of a chunk.

    Raises:
        ValueError: a kind of record that chunks do not contain.
    """
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.MESSAGE:
        return cast(Message, Message.read(stream, len(body)))
    if opcode == Opcode.CHANNEL:
        return cast(Channel, Channel.read(stream))
    if opcode == Opcode.SCHEMA:
        return cast(Schema, Schema.read(stream))
    raise ValueError(f"opcode {opcode} in a chunk")


def _is_of(message: Message, chunk: Chunk) -> bool:
    return bool(chunk.message_start_time <= message.log_time <= chunk.message_end_time)
