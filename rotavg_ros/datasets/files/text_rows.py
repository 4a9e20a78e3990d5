"""Reads and writes rows of numbers in text files: fast if there are no errors, and exact about the faulty line."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

import numpy as np
import numpy.typing as npt

from rotavg_ros.datasets.files.graph_file import MAX_NODE_ID, GraphFileError, open_text
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE

# Bytes read, and rows written, at a time. Many live token lists make Python's garbage collector walk them again and
# again: with blocks of 4 MiB reading takes three times as long.
_BLOCK_BYTES = 1 << 16
_BLOCK_ROWS = 1 << 14

_MOST_DIGITS = len(str(MAX_NODE_ID))

# First characters of a number.
NUMBER_STARTS = frozenset(bytes([character]) for character in b"0123456789+-.")

Row = list[bytes]


def read_blocks(path: Path) -> Iterator[list[tuple[int, Row]]]:
    """Blocks of ``(line number from 1, tokens)`` of a text, gzipped or not, without blank lines and comments."""
    first_line = 1
    with open_text(path) as file:
        while lines := file.readlines(_BLOCK_BYTES):
            tokens = enumerate((line.split() for line in lines), start=first_line)
            yield [(number, row) for number, row in tokens if row and not row[0].startswith(b"#")]
            first_line += len(lines)


def parse_rows(path: Path, lines: list[int], rows: list[Row], num_ids: int, num_values: int) -> tuple[np.ndarray, ...]:
    """Rows of ``num_ids`` ids and then ``num_values`` finite numbers.

    Args:
        lines: line number of every row, for the message.

    Returns:
        ``(K, num_ids)`` int64 and ``(K, num_values)`` float64.

    Raises:
        GraphFileError: the message names the first line that is not of that form.
    """
    num_columns = num_ids + num_values
    try:
        if any(len(row) != num_columns for row in rows) or b"_" in b" ".join(chain.from_iterable(rows)):
            raise ValueError  # Python takes 1_0 for 10
        ids = np.fromiter(map(int, chain.from_iterable(row[:num_ids] for row in rows)), np.int64)
        numbers = np.fromiter(map(float, chain.from_iterable(islice(row, num_ids, None) for row in rows)), np.float64)
    except (ValueError, OverflowError):
        problems = ((line, _problem(row, num_ids, num_columns)) for line, row in zip(lines, rows, strict=True))
        line, problem = next((line, problem) for line, problem in problems if problem)
        raise GraphFileError.at(path, line, problem) from None
    ids, numbers = ids.reshape(len(rows), num_ids), numbers.reshape(len(rows), num_values)
    refuse(path, lines, (ids < 0).any(axis=1), "a negative id; ids must be integers from 0")
    refuse(path, lines, ~np.isfinite(numbers).all(axis=1), "a number that is not finite (nan or inf); remove the line")
    return ids, numbers


def unit_quaternions(path: Path, lines: list[int] | np.ndarray | None, quaternions: np.ndarray) -> np.ndarray:
    """``(K, 4)`` quaternions normalised, or a refusal that names the first one farther than 1e-3 from unit length."""
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(quaternions, axis=1)
    not_unit = ~(np.abs(norm - 1) <= UNIT_NORM_TOLERANCE)
    where = int(np.argmax(not_unit)) if not_unit.any() else 0
    what = f"a quaternion of length {norm[where]:.6g}; it must be of unit length" if len(norm) else ""
    refuse(path, lines, not_unit, what)
    return np.asarray(quaternions / norm[:, None])


def refuse(path: Path, lines: list[int] | np.ndarray | None, bad: npt.ArrayLike, what: str) -> None:
    """Raise for the first row marked in ``bad``; ``lines`` is None if rows are edges of a binary file."""
    bad = np.asarray(bad)
    if not bad.any():
        return
    row = int(np.argmax(bad))
    if lines is None:
        raise GraphFileError.at(path, None, f"edge {row} (from 0) has {what}")
    raise GraphFileError.at(path, int(lines[row]), what)


def write_rows(file: TextIO, row_format: str, columns: list[np.ndarray]) -> None:
    """Write one ``row_format`` (a % format, newline included) per row of the columns, each ``(K,)`` or ``(K, C)``."""
    lists = [array.T.tolist() if array.ndim == 2 else [array.tolist()] for array in columns]
    rows = chain.from_iterable(zip(*chain.from_iterable(lists), strict=True))
    width = sum(map(len, lists))
    for start in range(0, len(columns[0]), _BLOCK_ROWS):
        count = min(_BLOCK_ROWS, len(columns[0]) - start)
        file.write((row_format * count) % tuple(islice(rows, count * width)))


def wrong_width(number: int, needed: int) -> str:
    """What is wrong with a row of so many numbers."""
    numbers = "1 number" if number == 1 else f"{number} numbers"
    return f"{numbers} where {needed} belong; the line is malformed or the file truncated"


def _problem(row: Row, num_ids: int, num_columns: int) -> str | None:
    """What is wrong with a row, if anything."""
    if len(row) != num_columns:
        return wrong_width(len(row), num_columns)
    for token in row[:num_ids]:
        if not token[token[:1] in (b"+", b"-") :].isdigit():
            return f"{shown(token)} is not an integer id"
        if len(token.lstrip(b"+-0")) > _MOST_DIGITS or int(token) > MAX_NODE_ID:
            return f"id {shown(token)} is too large; ids must be at most {MAX_NODE_ID}"
    for token in row[num_ids:]:
        try:
            float(token.replace(b"_", b"?"))
        except ValueError:
            return f"{shown(token)} is not a number"
    return None


def shown(token: bytes) -> str:
    """A token of unknown content, made safe for a message."""
    text = token[:40].decode("ascii", "backslashreplace")
    return repr(text + "…" if len(token) > 40 else text)
