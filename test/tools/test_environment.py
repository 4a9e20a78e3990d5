"""The set-up: what it says of an unfit machine, what it repairs, when it has nothing to do."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import environment
import pytest
import workspace_hook
from cmake_exports import repair_cmake_exports

TOOLS = Path(environment.__file__).parent
EXPORT = """set_target_properties(std_msgs::std_msgs__rosidl_generator_py PROPERTIES
  INTERFACE_INCLUDE_DIRECTORIES "/opt/python/cp312-cp312/include/python3.12;{numpy}"
)
"""


@pytest.mark.parametrize("core", ["core", "_core"])
def test_cmake_exports_are_pointed_at_this_interpreter(tmp_path: Path, core: str) -> None:
    export = tmp_path / "share" / "std_msgs" / "cmake" / "std_msgsExport.cmake"
    export.parent.mkdir(parents=True)
    numpy = f"/opt/python/cp312-cp312/lib/python3.12/site-packages/numpy/{core}/include"
    export.write_text(EXPORT.format(numpy=numpy))
    innocent = export.with_name("std_msgsConfig.cmake")
    innocent.write_text('set(include "/opt/ros/include")')

    assert repair_cmake_exports(tmp_path, Path("/usr/include/python3.12"), Path("/venv/numpy/include")) == 1
    assert '"/usr/include/python3.12;/venv/numpy/include"' in export.read_text()
    assert innocent.read_text() == 'set(include "/opt/ros/include")'
    assert repair_cmake_exports(tmp_path, Path("/elsewhere"), Path("/elsewhere")) == 0


def test_no_installed_export_names_the_build_container() -> None:
    """The real environment, after its set-up."""
    exports = list(Path(sys.prefix).glob("share/*/cmake/*Export.cmake"))
    if not exports:
        pytest.skip("ROS 2 does not come from wheels here")
    assert [path.name for path in exports if "/opt/python" in path.read_text()] == []


@pytest.mark.parametrize("missing", ["g++", "make"])
def test_missing_tool_is_named_with_a_remedy(missing: str) -> None:
    with pytest.raises(environment.SetupError, match=rf"{missing.replace('+', '.')} was not found; install it"):
        environment.check_machine(which=lambda tool: None if tool == missing else f"/usr/bin/{tool}")


def test_missing_headers_are_named_with_a_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environment.sysconfig, "get_paths", lambda: {"include": str(tmp_path)})
    with pytest.raises(environment.SetupError, match=r"apt install python3\.\d+-dev python3\.\d+-venv"):
        environment.check_machine()


def test_other_machines_are_referred_to_a_workspace(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment.platform, "machine", lambda: "aarch64")
    with pytest.raises(environment.SetupError, match="build the package in a ROS 2 workspace"):
        environment.check_machine()


def test_folder_with_a_space_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(environment, "ROOT", tmp_path / "some one" / "rotavg_ros")
    with pytest.raises(environment.SetupError, match="space in its name"):
        environment.check_machine()


def test_unsupported_python_is_one_line() -> None:
    code = "import sys; sys.version_info = (3, 8, 18); import setup_environment; setup_environment.main()"
    answer = subprocess.run([sys.executable, "-c", code], cwd=TOOLS, capture_output=True, text=True, check=False)
    assert answer.returncode == 1
    assert "Python 3.10 to 3.13 is needed" in answer.stderr
    assert len(answer.stderr.splitlines()) == 1


def test_step_is_stale_until_it_succeeds_and_when_an_input_changes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(environment, "ROOT", tmp_path)
    monkeypatch.setattr(environment, "STATE", tmp_path)
    source, product = tmp_path / "source", tmp_path / "product"
    source.write_text("one")

    def is_stale(fails: bool = False) -> bool:
        with environment.stamp("step", [source], [product]) as stale:
            if fails:
                raise environment.SetupError
            product.touch()
        return stale

    with pytest.raises(environment.SetupError):
        is_stale(fails=True)
    assert [is_stale(), is_stale()] == [True, False]
    source.write_text("two")
    assert [is_stale(), is_stale()] == [True, False]
    product.unlink()
    assert [is_stale(), is_stale()] == [True, False]


def workspace(root: Path) -> Path:
    """A fake checkout with a built workspace; returns its virtual environment."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    for folder in ("rotavg_ros/lib", f"rotavg_msgs/lib/{version}/site-packages"):
        (root / "install" / folder).mkdir(parents=True)
    (root / "install" / "rotavg_msgs" / "lib" / "librotavg_msgs.so").touch()
    return root / ".venv"


def test_hook_puts_the_workspace_first_and_is_idempotent(tmp_path: Path) -> None:
    venv = workspace(tmp_path)
    environ = {"AMENT_PREFIX_PATH": f"/opt/other:{venv}", "_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1"}
    module_path = ["/first"]
    workspace_hook.activate(venv, environ, module_path)
    install = tmp_path / "install"
    assert environ["AMENT_PREFIX_PATH"] == f"{install}/rotavg_ros:{install}/rotavg_msgs:{venv}:/opt/other"
    assert environ["LD_LIBRARY_PATH"] == f"{install}/rotavg_msgs/lib"
    assert "_ROS_WHEELS_BOOTSTRAP_COMPLETE" not in environ  # so that the wheels restart Python with the new path
    assert module_path[0] == "/first"
    assert len(module_path) == 2

    environ["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    before = dict(environ)
    workspace_hook.activate(venv, environ, module_path)
    assert environ == before
    assert len(module_path) == 2


def test_hook_does_nothing_without_a_workspace_or_when_told_so(tmp_path: Path) -> None:
    environ: dict[str, str] = {}
    workspace_hook.activate(tmp_path / ".venv", environ, [])
    assert environ == {}
    environ = {workspace_hook.OPT_OUT: "1"}
    workspace_hook.activate(workspace(tmp_path), environ, [])
    assert environ == {workspace_hook.OPT_OUT: "1"}
