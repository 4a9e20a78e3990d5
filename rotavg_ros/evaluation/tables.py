"""Tables of results, as Markdown and CSV."""

from __future__ import annotations

import csv
import io
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from rotavg_ros.errors import UserError
from rotavg_ros.version import __version__

Cell = str | float | int | None


class ReportError(UserError):
    """Results that cannot be written."""


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
        """Headings and rows, numbers in full."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([column.heading for column in self.columns])
        writer.writerows(["" if _is_empty(cell) else cell for cell in row] for row in self.rows)
        return text.getvalue()

    def _texts(self, row: Sequence[Cell]) -> list[str]:
        return [
            "" if _is_empty(cell) else cell if isinstance(cell, str) else format(cell, column.format)
            for cell, column in zip(row, self.columns, strict=True)
        ]


def write_report(
    folder: Path,
    name: str,
    title: str,
    introduction: str,
    tables: Mapping[str, Table],
    pictures: Mapping[str, str],
    extra_csv: Mapping[str, Table] | None = None,
) -> Path:
    """Write ``name.md`` with all tables and pictures, and a CSV file per table.

    Args:
        tables: by the stem of their CSV file.
        pictures: caption by file name; the files are in ``folder`` already.
        extra_csv: tables that are too long to be read, as CSV only.

    Returns:
        The Markdown file.

    Raises:
        ReportError: the folder cannot be written.
    """
    parts = [f"# {title}\n", introduction + "\n", *(table.to_markdown() for table in tables.values())]
    parts += [f"![{caption}]({file})\n" for file, caption in pictures.items()]
    parts.append(f"_{provenance()}_\n")
    report = folder / f"{name}.md"
    try:
        for stem, table in {**tables, **(extra_csv or {})}.items():
            (folder / f"{stem}.csv").write_text(table.to_csv(), encoding="utf-8")
        report.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise ReportError(f"{folder}: cannot be written ({error.strerror})") from None
    return report


def make_folder(folder: Path) -> None:
    """Create a folder to write to before hours of work depend on it.

    Raises:
        ReportError: it cannot be, or nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ReportError(f"{folder}: cannot be used as a folder ({error.strerror}); choose another") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ReportError(f"{folder}: cannot be written (Permission denied); choose another")


def provenance() -> str:
    """What produced the figures: version, commit, machine."""
    return (
        f"rotavg_ros {__version__}, commit {commit()}; torch {torch.__version__}, {torch.get_num_threads()} of "
        f"{os.cpu_count()} CPU threads, {platform.machine()}"
    )


def commit() -> str:
    """Of the sources that run, "-dirty" where they have been changed since; "unknown" outside a checkout."""
    try:
        command = ["git", "describe", "--always", "--dirty"]
        result = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return result.stdout.strip()


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _is_empty(cell: Cell) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))
