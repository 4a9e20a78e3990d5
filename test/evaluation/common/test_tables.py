from __future__ import annotations

import csv
from pathlib import Path

import pytest

from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.tables import Column, Report, Table

TABLE = Table(
    "Errors",
    (Column("method"), Column("mean °", ".2f"), Column("graphs", "d")),
    (("ours", 1.23456, 1_234_567), ("theirs", float("nan"), None)),
    ("A note.",),
)


def test_markdown() -> None:
    assert TABLE.to_markdown() == (
        "## Errors\n\n"
        "| method | mean ° | graphs |\n"
        "| --- | ---: | ---: |\n"
        "| ours | 1.23 | 1234567 |\n"
        "| theirs |  |  |\n"
        "\nA note.\n"
    )


def test_csv_has_five_digits_and_whole_numbers_in_full() -> None:
    rows = list(csv.reader(TABLE.to_csv().splitlines()))
    assert rows == [["method", "mean °", "graphs"], ["ours", "1.2346", "1234567"], ["theirs", "", ""]]


def test_report(tmp_path: Path) -> None:
    path = Report("report", "Title", "Words.", {"errors": TABLE}, {"a.png": "Caption"}, {"more": TABLE}).write(tmp_path)
    text = path.read_text()
    assert text.startswith("# Title\n\nWords.\n")
    assert "![Caption](a.png)" in text
    assert text.count("## Errors") == 1
    assert {file.name for file in tmp_path.iterdir()} == {"report.md", "errors.csv", "more.csv"}


def test_folder_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be written"):
        Report("report", "", "", {"errors": TABLE}).write(tmp_path / "nowhere")
