"""Rows of the robustness page from earlier runs: each takes an hour, so a run of some keeps all others."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rotavg_ros.evaluation.common.tables import Cell, Column, Table


@dataclass(frozen=True)
class EarlierRows:
    """The rows of a table in a folder, read from its CSV file.

    Attributes:
        rows: in the file's order; empty if there is no file, or if it has other columns.
    """

    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, folder: Path, stem: str, columns: Sequence[Column]) -> EarlierRows:
        """Read them."""
        with suppress(OSError, ValueError, csv.Error):  # missing, empty, or no text
            with (folder / f"{stem}.csv").open(encoding="utf-8", newline="") as file:
                header, *rows = csv.reader(file)
            if header == [column.heading for column in columns] and all(len(row) == len(header) for row in rows):
                return cls(tuple(tuple(map(_cell, row)) for row in rows))
        return cls(())

    def by(self, *columns: int) -> dict[tuple[Cell, ...], tuple[Cell, ...]]:
        """Rows by the values of some columns."""
        return {tuple(row[column] for column in columns): row for row in self.rows}

    def beside(self, rows: Sequence[tuple[Cell, ...]], *columns: int) -> tuple[tuple[Cell, ...], ...]:
        """The earlier rows whose values in some columns do not occur in the given rows, then the given rows."""
        given = {tuple(row[column] for column in columns) for row in rows}
        others = (row for row in self.rows if tuple(row[column] for column in columns) not in given)
        return (*others, *rows)


def with_earlier(folder: Path, stem: str, table: Table, *columns: int) -> Table:
    """A table, preceded by the folder's earlier rows whose values in some columns do not occur in it."""
    earlier = EarlierRows.of(folder, stem, table.columns)
    return Table(table.title, table.columns, earlier.beside(table.rows, *columns), table.notes)


def _cell(text: str) -> Cell:
    if text == "":
        return None
    with suppress(ValueError):
        return int(text)
    with suppress(ValueError):
        return float(text)
    return text
