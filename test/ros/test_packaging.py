"""What ROS tools need of the two packages: the ament index, executables that start and end well, clear definitions."""

from __future__ import annotations

import importlib
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

ament_packages = pytest.importorskip("ament_index_python.packages", reason="ROS 2 is not installed")
catkin_package = pytest.importorskip("catkin_pkg.package", reason="catkin_pkg is not installed")

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = ("rotavg", "rotavg_node")
DEFINITIONS = sorted((ROOT / "msg_defs").glob("*/*.???"))
VERSION = runpy.run_path(str(ROOT / "rotavg_ros" / "version.py"))["__version__"]


def executable_for_ros2_run(name: str) -> Path:
    """The file that `ros2 run rotavg_ros <name>` starts."""
    return Path(ament_packages.get_package_prefix("rotavg_ros")) / "lib" / "rotavg_ros" / name


@pytest.mark.parametrize("folder", [".", "msg_defs"])
def test_package_xml_is_valid_and_states_the_version(folder: str) -> None:
    warnings: list[str] = []
    package = catkin_package.parse_package(str(ROOT / folder), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []
    assert package.package_format == 3
    assert package.version == VERSION


def test_installed_distribution_states_the_version() -> None:
    assert metadata.version("rotavg_ros") == VERSION


def test_colcon_finds_both_packages_with_their_types() -> None:
    command = [sys.executable, "-m", "colcon", "--log-base", os.devnull]
    command += ["list", "--base-paths", ".", "msg_defs"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert sorted(line.split("\t") for line in listed.splitlines()) == [
        ["rotavg_msgs", "msg_defs", "(ros.ament_cmake)"],
        ["rotavg_ros", ".", "(ros.ament_python)"],
    ]


@pytest.mark.parametrize("name", ["rotavg_msgs", "rotavg_ros"])
def test_package_is_in_the_ament_index(name: str) -> None:
    share = Path(ament_packages.get_package_share_directory(name))
    assert (share / "package.xml").is_file()


@pytest.mark.parametrize("name", EXECUTABLES)
def test_ros2_run_finds_an_executable(name: str) -> None:
    assert os.access(executable_for_ros2_run(name), os.X_OK)


@pytest.mark.parametrize("how", ["ros2 run", "pip"])
def test_command_line_starts(how: str) -> None:
    script = executable_for_ros2_run("rotavg") if how == "ros2 run" else Path(sys.executable).with_name("rotavg")
    answer = subprocess.run([script, "--help"], capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    assert "solve" in answer.stdout


@pytest.mark.ros
@pytest.mark.parametrize(
    ("where", "how"),
    [
        ("ros2 run", signal.SIGINT),
        ("pip", signal.SIGTERM),
        pytest.param("ros2 run", signal.SIGTERM, marks=pytest.mark.large),
        pytest.param("pip", signal.SIGINT, marks=pytest.mark.large),
    ],
)
def test_node_starts_and_ends_cleanly(where, how, start_process, probe_node, wait_until) -> None:
    script = (
        executable_for_ros2_run("rotavg_node") if where == "ros2 run" else Path(sys.executable).with_name("rotavg_node")
    )
    node = start_process(script, "--ros-args", "-r", "__node:=packaging_test_node")
    wait_until(lambda: "packaging_test_node" in probe_node.get_node_names(), node)
    assert node.stop(how) == 0, node.output
    assert "Traceback" not in node.output


@pytest.mark.parametrize("definition", DEFINITIONS, ids=lambda path: path.stem)
def test_every_field_of_a_message_is_commented(definition: Path) -> None:
    above = ""
    for line in definition.read_text(encoding="utf-8").splitlines():
        if line and line != "---" and not line.startswith("#"):
            assert above.startswith("#"), f"{definition.name}: `{line}` lacks a comment in the line above"
        above = line


@pytest.mark.parametrize("definition", DEFINITIONS, ids=lambda path: path.stem)
def test_message_is_importable_with_its_fields(definition: Path) -> None:
    message = getattr(importlib.import_module(f"rotavg_msgs.{definition.parent.name}"), definition.stem)
    text = definition.read_text(encoding="utf-8").partition("---")[0]
    fields = re.findall(r"^[a-z_0-9/]+(?:\[(?:<=\d+)?\])? ([a-z_]+)$", text, re.MULTILINE | re.IGNORECASE)
    request = getattr(message, "Request", message)
    assert list(request.get_fields_and_field_types()) == fields
    constants = re.findall(r"^uint8 ([A-Z_]+)=(\d+)$", text, re.MULTILINE)
    assert all(getattr(request, name) == int(value) for name, value in constants)


def test_wheel_contains_every_file_of_the_package_and_the_ros_files(tmp_path: Path) -> None:
    source = tmp_path / "source"
    for name in ("rotavg_ros", "requirements", "resource"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--wheel-dir", tmp_path, source], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    contents = set(zipfile.ZipFile(wheel).namelist())
    files = (path for path in (ROOT / "rotavg_ros").rglob("*.*") if path.parent.name != "__pycache__")
    missing = {path.relative_to(ROOT).as_posix() for path in files} - contents
    assert missing == set()
    installed = {name.partition(".data/data/")[2] for name in contents}
    assert {"share/ament_index/resource_index/packages/rotavg_ros", "share/rotavg_ros/package.xml"} <= installed
