"""Numeric csv files, written tens of times faster than row by row: digits are computed for whole columns.

The columns of an answer's two tables are defined here, the same for every program that writes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import BinaryIO, NamedTuple

import numpy as np

# Rows written at once by default: some MB of characters.
_BLOCK_ROWS = 1 << 16


class Column(NamedTuple):
    """A named column of ``(K,)`` numbers. ``decimals`` is 0 for integers and at most 12, for values below 10⁶.

    NaN leaves a field empty.
    """

    name: str
    values: np.ndarray
    decimals: int = 0


def orientation_columns(
    ids: np.ndarray, world_from_body: np.ndarray, component: np.ndarray, uncertainty: np.ndarray
) -> list[Column]:
    """Columns of ``orientations.csv``.

    Args:
        ids, component: ``(N,)``.
        world_from_body: ``(N, 4)`` xyzw.
        uncertainty: ``(N,)`` rad, standard deviation of each component of an orientation's error; NaN unknown.
    """
    sigma_deg = np.degrees(np.where(np.isfinite(uncertainty), uncertainty, np.nan))
    quaternion = [Column(name, world_from_body[:, i], decimals=12) for i, name in enumerate(("qx", "qy", "qz", "qw"))]
    return [Column("id", ids), *quaternion, Column("component", component), Column("sigma_deg", sigma_deg, decimals=6)]


def edge_columns(
    ends: tuple[np.ndarray, np.ndarray],
    score: np.ndarray,
    outlier: np.ndarray,
    judged: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
) -> list[Column]:
    """Columns of ``edges.csv``.

    Args:
        ends: ids of the sources and of the targets, ``(M,)`` each.
        score, outlier: ``(M,)`` in [0, 1], and bool.
        judged: ``(M,)`` each, where translations were used: the rotation's own score, and the residuals in degrees and
            in metres (NaN without a translation).
    """
    columns = [
        Column("source", ends[0]),
        Column("target", ends[1]),
        Column("outlier_score", score, decimals=6),
        Column("outlier", outlier.astype(np.int64)),
    ]
    if judged is not None:
        rotation_score, residual_deg, residual_m = judged
        columns += [
            Column("rotation_score", rotation_score, decimals=6),
            Column("residual_deg", residual_deg, decimals=4),
            Column("residual_m", residual_m, decimals=4),
        ]
    return columns


def write_csv(file: BinaryIO, columns: Sequence[Column], *, block_rows: int = _BLOCK_ROWS) -> None:
    """Write a header and one line per row.

    Args:
        file: open for bytes.
        columns: of the same length.
        block_rows: number of rows in memory at a time; the output does not depend on it.

    Raises:
        ValueError: an infinite value.
    """
    file.write((",".join(column.name for column in columns) + "\n").encode("ascii"))
    for start in range(0, len(columns[0].values), block_rows):
        block = slice(start, start + block_rows)
        parts = []
        for column in columns:
            parts += [_digits(column.values[block], column.decimals), _literal(b",", len(column.values[block]))]
        parts[-1][0][:] = ord("\n")
        characters = np.concatenate([part[0] for part in parts], axis=1)
        keep = np.concatenate([part[1] for part in parts], axis=1)
        file.write(characters[keep].tobytes())


def _digits(values: np.ndarray, decimals: int) -> tuple[np.ndarray, np.ndarray]:
    """``(K, W)`` characters of right-aligned numbers, and which of them to keep (not the leading zeros)."""
    known = np.ones((len(values), 1), dtype=bool)
    if decimals:
        if np.isinf(values).any():
            raise ValueError("a csv column holds an infinite value")
        known = ~np.isnan(values)[:, None]
        values = np.rint(np.nan_to_num(values, nan=0.0).astype(np.float64) * 10.0**decimals)
    number = values if np.issubdtype(values.dtype, np.unsignedinteger) else values.astype(np.int64)
    rest = np.abs(number)
    num_digits = max(decimals + 1, len(str(rest.max(initial=0))))
    characters, keep = [], []
    for place in range(num_digits):
        if place == decimals and decimals:
            point, always = _literal(b".", len(number))
            characters.append(point)
            keep.append(always)
        significant = (rest > 0) | (place <= decimals)
        rest, digit = np.divmod(rest, 10)
        characters.append((digit + ord("0")).astype(np.uint8)[:, None])
        keep.append(significant[:, None])
    characters.append(_literal(b"-", len(number))[0])
    keep.append((number < 0)[:, None])
    return np.concatenate(characters[::-1], axis=1), np.concatenate(keep[::-1], axis=1) & known


def _literal(character: bytes, num_rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full((num_rows, 1), ord(character), dtype=np.uint8), np.ones((num_rows, 1), dtype=bool)
