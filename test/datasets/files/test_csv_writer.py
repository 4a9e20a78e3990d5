"""The column-wise csv writer against Python's own formatting."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.datasets.files.csv_writer import Column, write_csv

INTEGERS = st.integers(-(2**62), 2**63 - 1)
REALS = st.floats(-1000, 1000)


@given(st.lists(st.tuples(INTEGERS, REALS, st.integers(0, 1)), max_size=30), st.integers(1, 12), st.integers(1, 5))
def test_rows(rows: list[tuple[int, float, int]], decimals: int, block: int) -> None:
    columns = [np.array([row[i] for row in rows], dtype=[np.int64, np.float64, np.int64][i]) for i in range(3)]
    file = io.BytesIO()
    named = [Column("a", columns[0]), Column("b", columns[1], decimals), Column("c", columns[2])]
    write_csv(file, named, block_rows=block)
    header, *lines = file.getvalue().decode().splitlines()
    assert header == "a,b,c"
    assert len(lines) == len(rows)
    for line, (integer, real, flag) in zip(lines, rows, strict=True):
        cells = line.split(",")
        assert (int(cells[0]), int(cells[2])) == (integer, flag)
        assert len(cells[1].split(".")[1]) == decimals
        assert float(cells[1]) == pytest.approx(real, abs=0.5 * 10**-decimals + 1e-12)


def test_refuses_what_is_infinite_and_leaves_what_is_unknown_empty() -> None:
    with pytest.raises(ValueError, match="infinite"):
        write_csv(io.BytesIO(), [Column("a", np.array([np.inf]), decimals=3)])
    file = io.BytesIO()
    columns = Column("a", np.array([1, 2])), Column("b", np.array([np.nan, -0.5]), decimals=3)
    write_csv(file, [*columns, columns[0]._replace(name="c")])
    assert file.getvalue() == b"a,b,c\n1,,1\n2,-0.500,2\n"


def test_ids_of_64_bits_without_a_sign() -> None:
    file = io.BytesIO()
    write_csv(file, [Column("a", np.array([0, 2**63, 2**64 - 1], dtype=np.uint64))])
    assert file.getvalue() == b"a\n0\n9223372036854775808\n18446744073709551615\n"
