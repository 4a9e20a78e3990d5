"""Signs of life: what a terminal shows while something takes long, and what it shows afterwards."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, suppress
from pathlib import Path

import pytest

from rotavg_ros.cli.main import main
from rotavg_ros.cli.progress import progress, seconds_bar, working
from rotavg_ros.errors import UserError

PATIENCE_S = 60.0


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@contextmanager
def on_a_terminal() -> Iterator[Terminal]:
    """Not a fixture: pytest sets stderr anew between those and the test."""
    with redirect_stderr(Terminal()) as terminal:
        yield terminal


def wait_for_seconds(terminal: Terminal, pattern: str) -> None:
    """Take long, as what is watched does, until the terminal has shown two different counts of seconds."""
    end = time.monotonic() + PATIENCE_S
    while len(set(re.findall(pattern, terminal.getvalue()))) < 2:
        assert time.monotonic() < end, f"no seconds that go on: {terminal.getvalue()!r}"
        time.sleep(0.01)


def test_a_bar_goes_on_while_its_first_item_takes_long() -> None:
    def slow() -> Iterator[int]:
        wait_for_seconds(terminal, r"solving:   0%[^\r]*\[(\d\d:\d\d)")
        yield 1

    with on_a_terminal() as terminal:
        assert list(progress(slow(), description="solving", total=1)) == [1]
    assert terminal.getvalue().endswith("\r")  # and is cleared


@pytest.mark.parametrize("fails", [False, True])
def test_one_long_step_counts_seconds(fails: bool) -> None:
    with on_a_terminal() as terminal, suppress(InterruptedError), working("reading"):
        wait_for_seconds(terminal, r"\rreading: (\d+) s ")
        if fails:
            raise InterruptedError
    assert terminal.getvalue().endswith("\r\033[K")


def test_solve_counts_seconds_while_it_compiles(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def compiled(*_: object, **__: object) -> None:
        wait_for_seconds(terminal, r"\rpreparing \([^\r]*compiled\): (\d+) s ")
        raise UserError("no such method")

    monkeypatch.setattr("rotavg_ros.cli.solve.solve", compiled)
    (tmp_path / "x.g2o").write_text("EDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1\n")
    with on_a_terminal() as terminal:
        assert main(["solve", str(tmp_path / "x.g2o"), "--output", str(tmp_path / "out")]) == 2


def test_a_short_step_shows_nothing() -> None:
    with on_a_terminal() as terminal, working("reading"):
        pass
    assert terminal.getvalue() == ""


def test_a_bar_of_seconds_goes_on_between_steps() -> None:
    with on_a_terminal() as terminal, seconds_bar("replaying", 10.0) as advance:
        advance(2.0)
        wait_for_seconds(terminal, r"replaying:  20%[^\r]* 2/10 s \[(\d\d:\d\d)")


def test_where_nobody_looks_nothing_is_shown() -> None:
    with redirect_stderr(io.StringIO()) as pipe, working("reading"), seconds_bar("replaying", 1.0) as advance:
        advance(1.0)
        assert list(progress([1, 2], description="solving")) == [1, 2]
    assert pipe.getvalue() == ""
