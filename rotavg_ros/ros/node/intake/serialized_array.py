"""A message as the middleware delivers it, taken apart element by element.

rclpy unpacks a message as a whole, which takes seconds for 100 000 elements, and nothing else runs meanwhile. Read from
the serialised bytes, an element takes ten microseconds, and the reader decides when to continue.

The bytes are CDR as in the OMG's DDSI-RTPS 2.5, chapter 10: two bytes name the representation, two are options, and
primitives are aligned to their size, counted from after these four.
"""

from __future__ import annotations

import importlib
import struct
from collections import namedtuple
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from rclpy.serialization import deserialize_message

from rotavg_ros.online.measurements import RejectedInputError, RejectReason

# Type names in message definitions, and their format characters in ``struct``.
_PRIMITIVES = {
    "boolean": "?",
    "octet": "B",
    "float": "f",
    "double": "d",
    "int8": "b",
    "int16": "h",
    "int32": "i",
    "int64": "q",
    "uint8": "B",
    "uint16": "H",
    "uint32": "I",
    "uint64": "Q",
}
# First two bytes of the representations that are read here: plain CDR in either byte order.
_BYTE_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_HEADER_BYTES = 4

# Takes the bytes after the header and a position in them; returns the value there and the position of its end.
_Read = Callable[[memoryview, int], tuple[Any, int]]


class SerializedArray:
    """A message of a header and a sequence, such as ``rotavg_msgs/RelativeRotationArray``.

    Attributes:
        header: a ``std_msgs/Header``, or an object with its fields.
        edges: iterator over the elements, which are read on demand; they have the fields of the element's message. If
            the bytes end too early, as of a sender with another definition of the message, it raises
            :class:`RejectedInputError`.
    """

    def __init__(self, serialized: bytes, message_type: type) -> None:
        """Take the serialised message, whose type has two fields: ``header``, and a sequence of messages."""
        fields: dict[str, str] = message_type.get_fields_and_field_types()  # type: ignore[attr-defined]
        (_, header_type), (name, sequence_type) = fields.items()
        self.header: Any
        self.edges: Iterator[Any]
        order, content, at = _BYTE_ORDERS.get(serialized[:2]), memoryview(serialized)[_HEADER_BYTES:], 0
        try:
            if order is None:
                whole = deserialize_message(serialized, message_type)
                self.header, self.edges = whole.header, iter(getattr(whole, name))
                return
            self.header, at = _reader(header_type, order)(content, at)
        except (struct.error, RuntimeError):  # the second is rclpy's
            self.header, order, content = _message_class(header_type)(), "<", content[:0]
        element_type = sequence_type.removeprefix("sequence<").removesuffix(">")
        self.edges = _elements(content, at, element_type, order)


def as_message(element: Any, message_type: type) -> Any:
    """An element as a message of its type, for publishing."""
    if isinstance(element, message_type):
        return element
    message = message_type()
    for name, type_name in message_type.get_fields_and_field_types().items():  # type: ignore[attr-defined]
        value = getattr(element, name)
        setattr(message, name, as_message(value, _message_class(type_name)) if "/" in type_name else value)
    return message


def _message_class(type_name: str) -> type:
    package, _, name = type_name.partition("/")
    message_type: type = getattr(importlib.import_module(f"{package}.msg"), name)
    return message_type


def _elements(content: memoryview, at: int, element_type: str, order: str) -> Iterator[Any]:
    read = _reader(element_type, order)
    try:
        length, at = _reader("uint32", order)(content, at)
        for _ in range(length):
            element, at = read(content, at)
            yield element
    except struct.error:
        raise RejectedInputError(RejectReason.MALFORMED_MESSAGE) from None


@cache
def _reader(type_name: str, order: str) -> _Read:
    """Reader of a field type, named as in ``get_fields_and_field_types``: primitive, string, sequence or message."""
    if type_name in _PRIMITIVES:
        return _primitive_reader(struct.Struct(order + _PRIMITIVES[type_name]))
    if type_name == "string":
        return _string_reader(_reader("uint32", order))
    if type_name.startswith("sequence<"):
        element_type, _, _ = type_name.removeprefix("sequence<").removesuffix(">").partition(",")
        return _sequence_reader(_reader("uint32", order), _reader(element_type, order))
    message_type = _message_class(type_name)
    fields = message_type.get_fields_and_field_types()  # type: ignore[attr-defined]
    readers = {field: _reader(field_type, order) for field, field_type in fields.items()}
    return _message_reader(message_type.__name__, readers)


def _primitive_reader(number: struct.Struct) -> _Read:
    size, unpack = number.size, number.unpack_from

    def read(content: memoryview, at: int) -> tuple[Any, int]:
        at = -(-at // size) * size
        return unpack(content, at)[0], at + size

    return read


def _string_reader(read_length: _Read) -> _Read:
    def read(content: memoryview, at: int) -> tuple[str, int]:
        length, at = read_length(content, at)  # includes the terminating zero
        return str(content[at : at + length - 1], "utf-8", "replace"), at + length

    return read


def _sequence_reader(read_length: _Read, read_element: _Read) -> _Read:
    def read(content: memoryview, at: int) -> tuple[list[Any], int]:
        length, at = read_length(content, at)
        elements = []
        for _ in range(length):
            element, at = read_element(content, at)
            elements.append(element)
        return elements, at

    return read


def _message_reader(name: str, readers: dict[str, _Read]) -> _Read:
    make = namedtuple(name, readers)  # type: ignore[misc]
    fields = tuple(readers.values())

    def read(content: memoryview, at: int) -> tuple[Any, int]:
        values = []
        for read_field in fields:
            value, at = read_field(content, at)
            values.append(value)
        return make(*values), at

    return read
