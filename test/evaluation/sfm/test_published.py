"""The page of the paper's figures is what the figures say."""

from __future__ import annotations

from pathlib import Path

from rotavg_ros.evaluation.sfm.published import REAL, ROBUSTNESS, SCANNET, SYNTHETIC
from rotavg_ros.evaluation.sfm.published_page import page
from rotavg_ros.evaluation.sfm.synthetic import ROWS

PAGE = Path(__file__).resolve().parents[3] / "docs" / "results" / "published.md"


def test_the_page_is_made_of_the_figures() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "write published_page.page() there"


def test_all_of_the_papers_tables_are_there() -> None:
    assert (len(SYNTHETIC), len(REAL), len(ROBUSTNESS), len(SCANNET)) == (16, 19, 10, 6)
    assert set(SYNTHETIC) <= set(ROWS)
    # Read once more in the paper's table 1: NeuRoRA, and its second pass.
    assert SYNTHETIC["neurora-paper"] == (1.45, 0.74, 0.21)
    assert SYNTHETIC["neurora-v2-paper"] == (1.30, 0.68, 0.30)
