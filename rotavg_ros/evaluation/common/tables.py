"""Tables of results, as Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rotavg_ros.results import ResultError, provenance

Cell = str | float | int | None

# A hundredth of a per cent: figures vary far more between seeds and machines.
_CSV_FORMAT = ".5g"


@dataclass(frozen=True)
class Column:
    """A heading and the number format (``".2f"``) of what stands below it; texts are left as they are."""

    heading: str
    format: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of cells; None and NaN are empty cells."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()

    def to_markdown(self) -> str:
        """Title, table and notes."""
        numeric = [any(isinstance(row[i], (int, float)) for row in self.rows) for i in range(len(self.columns))]
        lines = [
            _line([column.heading for column in self.columns]),
            _line(["---:" if is_number else "---" for is_number in numeric]),
            *(_line(self._texts(row)) for row in self.rows),
        ]
        notes = "".join(f"\n{note}\n" for note in self.notes)
        return f"## {self.title}\n\n" + "\n".join(lines) + "\n" + notes

    def to_csv(self) -> str:
        """Headings and rows, whatever the columns' formats; numbers that are not whole have five significant digits."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([column.heading for column in self.columns])
        writer.writerows([_csv_cell(cell) for cell in row] for row in self.rows)
        return text.getvalue()

    def _texts(self, row: Sequence[Cell]) -> list[str]:
        return [
            "" if _is_empty(cell) else cell if isinstance(cell, str) else format(cell, column.format)
            for cell, column in zip(row, self.columns, strict=True)
        ]


@dataclass(frozen=True)
class Report:
    """The report of a suite.

    Attributes:
        name: stem of the Markdown file.
        title, introduction: before the tables.
        tables: by the stem of their CSV file.
        pictures: caption by file name; the files are in the report's folder already.
        extra_csv: tables that are too long to be read, as CSV only.
    """

    name: str
    title: str
    introduction: str
    tables: Mapping[str, Table]
    pictures: Mapping[str, str] = field(default_factory=dict)
    extra_csv: Mapping[str, Table] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write ``name.md`` with all tables and pictures, and a CSV file per table; returns the Markdown file.

        Raises:
            ResultError: the folder cannot be written.
        """
        parts = [f"# {self.title}\n", self.introduction + "\n"]
        parts += [table.to_markdown() for table in self.tables.values()]
        parts += [f"![{caption}]({file})\n" for file, caption in self.pictures.items()]
        parts.append(f"_{provenance()}_\n")
        path = folder / f"{self.name}.md"
        try:
            for stem, table in {**self.tables, **self.extra_csv}.items():
                (folder / f"{stem}.csv").write_text(table.to_csv(), encoding="utf-8")
            path.write_text("\n".join(parts), encoding="utf-8")
        except OSError as error:
            raise ResultError(f"{folder}: cannot be written ({error.strerror})") from None
        return path


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _csv_cell(cell: Cell) -> str | int:
    if isinstance(cell, float):
        return "" if _is_empty(cell) else format(cell, _CSV_FORMAT)
    return "" if cell is None else cell


def _is_empty(cell: Cell) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))
