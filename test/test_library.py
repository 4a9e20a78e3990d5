"""The library as a stranger meets it: what it offers, and that offering it costs nothing."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rotavg_ros
from rotavg_ros import EdgeMeasurement, GraphFile, KeyframeReference, UserError, ViewGraph, solve, solve_batch

ROOT = Path(__file__).resolve().parents[1]
TRIANGLE = ViewGraph.create([0, 1, 0], [1, 2, 2], [[0, 0, 0, 1]] * 3)


def in_new_process(program: str) -> str:
    return subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_everything_offered_is_there_and_listed() -> None:
    assert {"solve", "ViewGraph", "Solution", "OnlineEstimator", "read_graph"} <= set(dir(rotavg_ros))
    assert dir(rotavg_ros) == sorted(rotavg_ros.__all__)
    for module in (rotavg_ros, rotavg_ros.solver):
        assert all(getattr(module, name) is not None for name in module.__all__)
        with pytest.raises(AttributeError, match="has no attribute 'solved'"):
            getattr(module, "solved")  # noqa: B009 - its absence is the point


def test_import_and_listing_load_nothing_heavy() -> None:
    heavy = ("torch", "numpy", "scipy", "rclpy", "rosbags", "matplotlib")
    program = f"import sys, rotavg_ros; dir(rotavg_ros); print([name for name in {heavy} if name in sys.modules])"
    assert in_new_process(program) == "[]\n"


@pytest.mark.parametrize("function", [solve, solve_batch, ViewGraph.create, rotavg_ros.read_graph])
def test_help_says_what_can_go_wrong(function: object) -> None:
    assert "Raises:" in (function.__doc__ or "")
    assert "Returns:" in (function.__doc__ or "") or function not in (solve, solve_batch)


@pytest.mark.large
def test_type_checkers_know_what_is_imported_late(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "user.py").write_text(
        "import rotavg_ros\n"
        "graph = rotavg_ros.ViewGraph.create([0], [1], [[0, 0, 0, 1]])\n"
        "reveal_type(rotavg_ros.solve(graph))\n"
        "reveal_type(rotavg_ros.solve(rotavg_ros.read_graph('my.g2o')).world_from_body)\n"
        "reveal_type(rotavg_ros.OnlineEstimator().tick())\n"
    )
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--follow-imports",
        "silent",
        "--config-file",
        str(ROOT / "pyproject.toml"),
    ]
    command += ["--cache-dir", str(tmp_path / "cache"), str(tmp_path / "user.py")]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False).stdout
    revealed = [line.partition('"')[2].rstrip('"') for line in said.splitlines() if "Revealed type" in line]
    assert [name.rpartition(".")[2] for name in revealed] == ["Solution", "Tensor", "Answer | None"], said


def test_content_of_a_file_is_solved_as_its_graph() -> None:
    content = GraphFile.from_ids(np.array([7, 9, 7]), np.array([9, 30, 30]), TRIANGLE.target_from_source.numpy())
    alone = solve(TRIANGLE)
    for solution in (solve(content), *solve_batch([content, TRIANGLE])):
        np.testing.assert_allclose(solution.body_from_world, alone.body_from_world, atol=1e-5)
    with pytest.raises(UserError, match=r"a list is no view-graph; make one with ViewGraph\.create or read one with "):
        solve([[0, 1]])  # type: ignore[arg-type]


def test_orientations_as_ros_states_them() -> None:
    turns = Rotation.from_rotvec([[0, 0, 0.5], [0.3, 0, 0]])
    solution = solve(ViewGraph.create([0, 1], [1, 2], source_from_target=turns.as_quat()))
    expected = Rotation.concatenate([Rotation.identity(), turns[0], turns[0] * turns[1]])
    np.testing.assert_allclose(solution.world_from_body, expected.as_quat(canonical=True), atol=1e-6)


def test_a_closure_as_ros_states_it() -> None:
    source, target = KeyframeReference("robot", 3), KeyframeReference("robot", stamp_ns=5)
    left = Rotation.from_euler("z", 30, degrees=True)
    edge = EdgeMeasurement.from_ros(1, source, target, left.as_quat(), (1.0, 2.0, 3.0), 25.0)
    np.testing.assert_allclose(edge.target_from_source, left.inv().as_quat())
    assert (edge.source, edge.target, edge.translation, edge.precision) == (source, target, (1.0, 2.0, 3.0), 25.0)


def test_the_online_example(capsys: pytest.CaptureFixture[str]) -> None:
    names = runpy.run_path(str(ROOT / "examples" / "online_in_python.py"))
    odometry, corrected, false = capsys.readouterr().out.splitlines()
    assert odometry == "odometry: 9.0° off in the mean"
    degrees = re.fullmatch(r"corrected: (.*)° off in the mean", corrected)
    assert degrees is not None and float(degrees[1]) < 1
    assert false == f"false closures: {' '.join(map(str, range(60, 300, 20)))}"
    last = Rotation.from_quat(names["latest"]) * names["true"][290].inv()
    assert last.magnitude() < np.radians(2)
