"""The benchmark on its smallest graphs: every contender in a process of its own, and a report of what came out."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from rotavg_ros.cli.main import main


def test_a_tiny_benchmark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pycolmap")
    options = ["--families", "sfm-sparse", "--max-pairs", "1000", "--minutes", "4", "--repeats", "2"]
    options += ["--contenders", "neurora", "neurora-v1", "colmap"]
    assert main(["benchmark", *options, "--output", str(tmp_path)]) == 0
    assert str(tmp_path / "benchmark.md") in capsys.readouterr().out
    with (tmp_path / "benchmark-sfm-sparse.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["solver"] for row in rows][:2] == ["rotavg", "rotavg without refinement"]
    assert "COLMAP" in {row["solver"] for row in rows}
    for row in rows:
        assert row["nodes"] == "100"
        assert 0 < float(row["fastest"]) <= float(row["s"]) <= float(row["slowest"])
        assert float(row["CPU s"]) > 0
        assert 0 < float(row["of it before MB"]) <= float(row["peak MB"])
    # All have solved the same graph: the robust ones to a few degrees, where measurements err by 15.
    assert all(float(row["mean error °"]) < 10 for row in rows)
    assert (tmp_path / "benchmark-scaling.png").stat().st_size > 0
    assert "## Our stages" in (tmp_path / "benchmark.md").read_text()


@pytest.mark.large
def test_hours_of_driving_with_a_limit(tmp_path: Path) -> None:
    options = ["--soak", "--hours", "0.12", "--max-keyframes", "150"]
    assert main(["benchmark", *options, "--output", str(tmp_path)]) == 0
    with (tmp_path / "benchmark-hours-150.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert int(last["keyframes"]) <= 150 and int(last["marginalised"]) > 200
    assert float(last["error °"]) < 0.8 * float(last["odometry's °"])


@pytest.mark.large
def test_ticks_beside_isam2(tmp_path: Path) -> None:
    options = ["--ticks", "4", "--keyframes", "60", "--busy", "1"]
    assert main(["benchmark", *options, "--output", str(tmp_path)]) == 0
    with (tmp_path / "benchmark-ticks-60-busy-1.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["ticks"] for row in rows] == ["4"] * 3
    assert all(float(row["last answer's error °"]) < 3 for row in rows)
    assert all(0 < float(row["answer p50 ms"]) <= float(row["answer max ms"]) for row in rows)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--busy 2", "--busy means nothing here; add --ticks N"),
        ("--ticks 10 --soak", "--ticks is a run of its own, of one size"),
        ("--hours 1", "--hours means nothing here; add --soak"),
        ("--max-keyframes 100", "--max-keyframes means nothing here; add --soak --hours H"),
        ("--soak --max-keyframes 100", "--max-keyframes means nothing here"),
        ("--soak --hours 1 --seconds 3", "--seconds means nothing here"),
        ("--soak --keyframes 10 20", "--soak is of one size, on all cores; give --small without it"),
        ("--soak --small", "--soak is of one size, on all cores; give --small without it"),
        ("--keyframes 100", "--keyframes means nothing here; give it with --small or --ticks, or with --soak"),
        ("--soak --hours -1", "--hours: is -1; it must be positive"),
        ("--soak --hours 1 --max-keyframes 0", "--max-keyframes: is 0; it must be 1 or more"),
        ("--min-pairs 100 --max-pairs 10", "--min-pairs 100 is more than --max-pairs 10"),
        ("--families slam --max-pairs 10", "no graph of slam has between 1 and 10 edges; they have about 200, 500"),
        ("--families slam --contenders shonan --max-pairs 200", "none of the contenders runs on these graphs"),
        ("--threads 0", "--threads: is 0; it must be 1 or more"),
        ("--threads 100000", "--threads: is 100000; it must be 1024 or less"),
        ("--repeats 0", "--repeats: is 0; it must be 1 or more"),
        ("--families magic", "invalid choice: 'magic'"),
    ],
)
def test_mistakes_leave_an_older_report(
    words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "benchmark.md").write_text("measured before")
    assert main(["benchmark", *words.split(), "--output", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert (tmp_path / "benchmark.md").read_text() == "measured before"
