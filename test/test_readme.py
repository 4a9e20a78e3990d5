"""What the README and the page of parameters say is so: tables, examples. (Their commands: test_docs.py.)"""

from __future__ import annotations

import re
import textwrap
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

from rotavg_ros import solve
from rotavg_ros.cli.main import COMMANDS
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.settings.text import to_markdown

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PARAMETERS = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")


def test_the_parameter_table_is_the_nodes_own() -> None:
    marked = r"^<!-- parameters: .*-->\n(.*?)^<!-- end of parameters -->$"
    table = re.search(marked, PARAMETERS, re.MULTILINE | re.DOTALL)
    assert table is not None
    assert table[1] == to_markdown(), "paste the output of rotavg_ros.settings.text.to_markdown()"


def test_every_command_is_in_the_table() -> None:
    section = README.partition("## The command line")[2]
    rows = re.findall(r"^\| `(\w+)", section, re.MULTILINE)
    assert set(rows) == {command.name for command in COMMANDS}


def test_git_ignores_what_its_commands_write() -> None:
    lines = (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()
    ignored = [line.strip("/") for line in lines if line and not line.startswith(("#", "!"))]
    written = set(re.findall(r"^    rotavg .*--output (\S+)", README, re.MULTILINE))
    written |= set(re.findall(r"^    rotavg convert \S+ (\S+)", README, re.MULTILINE))
    written |= set(re.findall(r"^    python3 -m venv (\S+)", README, re.MULTILINE))
    written |= {
        f"{stem}-statistics.png" for stem in re.findall(r"^    rotavg plot statistics (\w+)", README, re.MULTILINE)
    }
    assert written >= {"venv", "my_bag", "answer", "my_graph", "back.g2o", "my-statistics.png", "b25b"}
    assert {name for name in written if not any(fnmatch(name, pattern) for pattern in ignored)} == set()


def test_the_library_example() -> None:
    section = README.partition("## In Python")[2]
    example = re.search(r"(?:^(?:    .*)?\n)+", section[section.index("    from") :], re.MULTILINE)
    assert example is not None
    names: dict[str, Any] = {}
    exec(textwrap.dedent(example[0]), names)  # noqa: S102 - the README is ours
    solution = names["solution"]
    assert solution.body_from_world.shape == (4, 4)
    assert solution.outlier_score.shape == (4,)
    np.testing.assert_allclose(solution.body_from_world[0], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(solution.body_from_world[3], [0, 0, 0.296, 0.9552], atol=1e-3)


def test_the_online_example_is_the_one_that_is_run() -> None:
    """That of examples/, which a test runs."""
    section = README.partition("## Online in Python")[2].partition("\n## ")[0]
    (shown,) = re.findall(r"^```python\n(.*?)^```$", section, re.MULTILINE | re.DOTALL)
    example = (ROOT / "examples" / "online_in_python.py").read_text(encoding="utf-8")
    assert example.endswith(f"\n\n{shown}")


def test_the_example_of_direction(tmp_path: Path) -> None:
    """The g2o edge of the table, read and solved, gives the table's quaternions."""
    section = README.partition("*By example.*")[2].partition("\n## ")[0]
    (edge,) = re.findall(r"`(EDGE_SE2 .*?) …`", section)
    quaternions = {
        what: np.array([float(number.replace("−", "-")) for number in numbers.split(",")])
        for what, numbers in re.findall(r"^\| (.*?) \|.*\| \(([^)]*)\) \|$", section, re.MULTILINE)
    }
    outside, inside = quaternions["message"], quaternions["library"]
    (tmp_path / "example.g2o").write_text(f"{edge} 1 0 0 1 0 1\n")
    graph = read_graph(tmp_path / "example.g2o").graph
    np.testing.assert_allclose(graph.target_from_source[0], inside, atol=1e-4)
    np.testing.assert_allclose(solve(graph).body_from_world[1], inside, atol=1e-4)
    np.testing.assert_allclose(inside * [-1, -1, -1, 1], outside)
