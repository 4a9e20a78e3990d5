"""Arrows point inward: what may import what, read from the sources."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "rotavg_ros"
# The parts that others build on, and the parts of this package that they may import themselves.
INWARD = {
    "errors": set(),
    "view_graph": {"errors"},
    "rotations": set(),
    "solver": {"errors", "rotations", "view_graph"},
    "datasets": {"errors", "rotations", "view_graph"},
    "online": {"errors", "rotations", "solver", "view_graph"},
    "inputs": {"online", "view_graph"},
    "settings": {"errors", "inputs", "online", "solver", "view_graph"},
    "metrics": {"rotations", "view_graph"},
    "results": {"errors", "version"},
    "training": {"datasets", "errors", "metrics", "results", "rotations", "solver", "version", "view_graph"},
    "reports": {"errors", "metrics", "online", "replay", "version", "view_graph"},
    "evaluation": {
        *("baselines", "datasets", "errors", "metrics", "online", "reports", "results"),
        *("rotations", "solver", "training", "view_graph"),
    },
}
# Parts whose rooms (or modules beside them) have arrows among each other.
ROOMS = {
    "datasets": {
        "dead_reckoning": set(),
        "planar": set(),
        "files": {"dead_reckoning", "planar"},
        "simulation": {"files"},
    },
    "evaluation": {
        "common": set(),
        "benchmark": {"common"},
        "live": {"common"},
        "sfm": {"common"},
        "slam": {"common", "live"},
    },
}
# Imports from these name a part or a room after the word import.
PARTS = {PACKAGE.name, *(f"{PACKAGE.name}.{part}" for part in ROOMS)}
# Others' packages that only one part may know.
BORDERS = {"rclpy": "ros", "rosbags": "bags", "mcap": "bags"}


def imported(part: str) -> Iterator[tuple[str, str]]:
    """Modules that a part of the package imports, anywhere in it, and the file that does."""
    files = (PACKAGE / part).rglob("*.py") if (PACKAGE / part).is_dir() else [PACKAGE / f"{part}.py"]
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from ((alias.name, file.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module in PARTS:
                yield from ((f"{node.module}.{alias.name}", file.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield node.module, file.name


@pytest.mark.parametrize("part", INWARD)
def test_nothing_imports_outward(part: str) -> None:
    for module, file in imported(part):
        top, *inner = module.split(".")
        if top == PACKAGE.name:
            assert inner[0] in {part, *INWARD[part]}, f"{part}/{file} imports {module}"
        else:
            assert top not in BORDERS and not top.endswith("_msgs"), f"{part}/{file} imports {module}"


@pytest.mark.parametrize(("part", "room"), [(part, room) for part, rooms in ROOMS.items() for room in rooms])
def test_rooms_import_inward(part: str, room: str) -> None:
    for module, file in imported(f"{part}/{room}"):
        if module.startswith(f"{PACKAGE.name}.{part}."):
            assert module.split(".")[2] in {room, *ROOMS[part][room]}, f"{part}/{room}/{file} imports {module}"


@pytest.mark.parametrize("part", ROOMS)
def test_all_rooms_are_known(part: str) -> None:
    inside = {path.stem for path in (PACKAGE / part).iterdir() if not path.name.startswith("__")}
    assert inside == set(ROOMS[part])


def test_borders() -> None:
    parts = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")})
    assert set(INWARD) < set(parts)
    for part in parts:
        for module, file in imported(part):
            top = module.partition(".")[0]
            owner = "ros" if top.endswith("_msgs") else BORDERS.get(top, part)
            assert part == owner, f"{part}/{file} imports {module}, which only {owner} may know"
