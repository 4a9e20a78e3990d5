"""The steps of the set-up: check the machine, fill .venv, build the workspace, install the package.

Standard library only, since it runs before anything is installed.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from cmake_exports import repair_cmake_exports
from workspace_hook import OPT_OUT

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
INSTALL = ROOT / "install"
STATE = VENV / "rotavg-setup"  # stamps of the steps that succeeded
REQUIREMENTS = [ROOT / "requirements" / f"{name}.txt" for name in ("runtime", "ros", "dev", "peers")]
CONSTRAINTS = ROOT / "requirements" / "constraints.txt"
PACKAGES = {"rotavg_msgs": "ros.ament_cmake", "rotavg_ros": "ros.ament_python"}
TEST_INTERFACES = ROOT / "test" / "interfaces"
TEST_BUILD = ROOT / "build" / "test_interfaces"


COLCON_BUILD_OPTIONS = (
    *("--event-handlers", "desktop_notification-"),
    *("--cmake-args", f"-DPython3_EXECUTABLE={VENV}/bin/python", "-DBUILD_TESTING=OFF", "-Wno-unused-cli"),
)


class SetupError(Exception):
    """The set-up cannot go on; the message is one line for the user."""


def main(for_tests: bool = False) -> None:
    steps = [install_requirements, install_package]
    steps += [prepare_tests] if for_tests else [compile_bytecode, build_workspace]
    started = time.monotonic()
    try:
        check_machine()
        create_venv()
        with only_one_setup():
            done = [step() for step in steps]
    except SetupError as error:
        sys.exit(f"setup: error: {error}")
    except subprocess.CalledProcessError as error:
        sys.exit(f"setup: error: `{' '.join(map(str, error.cmd))}` failed (exit code {error.returncode}), see above")
    except KeyboardInterrupt:
        sys.exit("setup: interrupted; call it again to go on")
    if any(done):
        print(f"setup: done in {time.monotonic() - started:.0f} s", flush=True)


# What the machine must bring


def check_machine(which: Callable[[str], str | None] = shutil.which) -> None:
    """Raise SetupError unless everything is there that pip cannot install."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        raise SetupError(
            f"ROS 2 from PyPI exists for x86-64 Linux, this is {sys.platform} {platform.machine()}; "
            "build the package in a ROS 2 workspace instead (see README)"
        )
    if any(character.isspace() for character in str(ROOT)):
        raise SetupError(f"the ROS build tools cannot work below a folder with a space in its name, move it: {ROOT}")
    for tool, package in (("g++", "g++"), ("make", "make")):
        if which(tool) is None:
            raise SetupError(f"{tool} was not found; install it, for instance with `sudo apt install {package}`")
    if not python_is_complete():
        version = f"{sys.version_info[0]}.{sys.version_info[1]}"
        raise SetupError(
            f"Python {version} lacks its headers or its venv module; install them, for instance with "
            f"`sudo apt install python{version}-dev python{version}-venv`"
        )


def python_is_complete() -> bool:
    """Whether this interpreter can make virtual environments and has its C headers."""
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    return header.is_file() and all(importlib.util.find_spec(module) for module in ("venv", "ensurepip"))


# Steps; each returns whether it had to do anything


def create_venv() -> None:
    if not (VENV / "bin" / "python").exists():
        say(f"creating {VENV.name} with Python {platform.python_version()}")
        run([sys.executable, "-m", "venv", VENV])
    if ask_venv("import pip, sys; print(sys.prefix)") != [str(VENV)]:
        raise SetupError(f"{VENV} is broken or was moved, which environments do not survive; delete it and call again")
    STATE.mkdir(exist_ok=True)


def install_requirements() -> bool:
    """Install ROS 2, torch and everything else at pinned versions, and mend what the ROS wheels export."""
    with stamp("requirements", [*REQUIREMENTS, CONSTRAINTS, Path(__file__).with_name("cmake_exports.py")]) as stale:
        if stale:
            say("installing the pinned requirements (some minutes and 2 GB the first time)")
            files = [argument for file in REQUIREMENTS for argument in ("--requirement", file)]
            pip("install", "--no-compile", "--constraint", CONSTRAINTS, *files)
            python_include = ask_venv("import sysconfig; print(sysconfig.get_paths()['include'])")[0]
            numpy_include = ask_venv("import numpy; print(numpy.get_include())")[0]
            repair_cmake_exports(VENV, Path(python_include), Path(numpy_include))
    return stale


def compile_bytecode() -> bool:
    """Compile what is installed, on all cores; pip takes a minute for it on one. What no Python can compile is left.

    Where PYTHONDONTWRITEBYTECODE is set, as in many containers, each process would compile torch again. Packages' own
    tests are a quarter of it, and nobody imports them.
    """
    with stamp("all_bytecode", [*REQUIREMENTS, CONSTRAINTS]) as stale:
        if stale:
            folders = map(str, VENV.glob("lib/python3.*/site-packages"))
            command = [str(VENV / "bin" / "python"), "-m", "compileall", "-q", "-j", "0", "-x", "/tests/", *folders]
            subprocess.run(command, env=clean_environment(), check=False, capture_output=True)
    return stale


def build_workspace() -> bool:
    """Build the messages and the package with colcon; Python sources are linked, so only build files matter here."""
    inputs = [ROOT / name for name in ("package.xml", "setup.py", "setup.cfg", "rotavg_ros/version.py")]
    inputs += [*files_below(ROOT / "msg_defs"), *files_below(ROOT / "resource"), CONSTRAINTS, REQUIREMENTS[0]]
    outputs = [INSTALL / "rotavg_ros" / "lib" / "rotavg_ros" / name for name in ("rotavg", "rotavg_node")]
    outputs.append(INSTALL / "rotavg_msgs" / "share" / "rotavg_msgs" / "package.xml")
    with stamp("workspace", inputs, outputs) as stale:
        if stale:
            say("building rotavg_msgs and rotavg_ros with colcon")
            check_package_types()
            colcon(
                *("build", "--base-paths", ".", "msg_defs", "--symlink-install"),
                *COLCON_BUILD_OPTIONS,
                "-DCMAKE_BUILD_TYPE=Release",
            )
    return stale


def prepare_tests() -> bool:
    """Build everything, while numba takes one core, and code generators at most the other."""
    with ThreadPoolExecutor() as pool:
        loops = pool.submit(compile_loops)
        done = [build_workspace()]
        tests = pool.submit(collect_tests)
        done += [build_test_interfaces()]
    return any((*done, loops.result(), tests.result()))


def build_test_interfaces() -> bool:
    """Build stand-ins for others' message packages, apart from the workspace: only tests that ask for them see them."""
    packages = sorted(folder.parent for folder in TEST_INTERFACES.glob("*/package.xml"))
    inputs = [*files_below(TEST_INTERFACES), CONSTRAINTS, REQUIREMENTS[1]]
    outputs = [TEST_BUILD / "install" / "share" / package.name / "package.xml" for package in packages]
    with stamp("test_interfaces", inputs, outputs) as stale:
        if stale:
            say(f"building {', '.join(package.name for package in packages)} for the tests")
            colcon(
                *("build", "--base-paths", *map(str, packages)),
                *("--build-base", str(TEST_BUILD), "--install-base", str(TEST_BUILD / "install"), "--merge-install"),
                *COLCON_BUILD_OPTIONS,
            )
    return stale


def compile_loops() -> bool:
    """Have numba compile the solver's loops; else each process of the tests begins with that, for a minute.

    If it fails, the tests tell why.
    """
    program = Path(__file__).with_name("compile_loops.py")
    sources = [file for file in sorted((ROOT / "rotavg_ros").rglob("*.py")) if b"@compiled" in file.read_bytes()]
    with stamp("machine_code", [*sources, program, CONSTRAINTS]) as stale:
        if stale:
            say("compiling the solver's loops for the tests")
            command = [str(VENV / "bin" / "python"), str(program)]
            subprocess.run(command, cwd=ROOT, env=clean_environment(), check=False, capture_output=True)
    return stale


def collect_tests() -> bool:
    """Have Python compile what tests import, and pytest rewrite them; else each process of a first run does both.

    All that is installed would be 2.6 times as many files (:func:`compile_bytecode`). If it fails, the tests tell why.
    """
    with stamp("tests_bytecode", [*REQUIREMENTS, CONSTRAINTS]) as stale:
        if stale:
            command = [str(VENV / "bin" / "python"), "-m", "pytest", "--collect-only", "-q"]
            subprocess.run(command, cwd=ROOT, env=clean_environment(), check=False, capture_output=True)
    return stale


def check_package_types() -> None:
    """An invalid package.xml silently turns a package into a plain one; colcon's own list shows it."""
    listed = colcon("list", "--base-paths", ".", "msg_defs", output=True)
    found = {name: kind.strip("()") for name, _, kind in (line.split() for line in listed.splitlines())}
    if found != PACKAGES:
        raise SetupError(f"colcon found {found} where {PACKAGES} was expected; a package.xml must be invalid")


def install_package() -> bool:
    """Install the package in editable form, and the hook that lets the environment see the workspace."""
    hook = Path(__file__).with_name("workspace_hook.py")
    inputs = [hook, *(ROOT / name for name in ("setup.py", "rotavg_ros/version.py", "rotavg_ros/__init__.py"))]
    outputs = [VENV / "bin" / name for name in ("rotavg", "rotavg_node")]
    with stamp("package", [*inputs, REQUIREMENTS[0]], outputs) as stale:
        if stale:
            say("installing rotavg_ros into the environment")
            pip("install", "--no-deps", "--no-build-isolation", "--editable", ROOT)
            site_packages = next(VENV.glob("lib/python3.*/site-packages"))
            shutil.copyfile(hook, site_packages / "rotavg_workspace.py")
            # The underscore sorts it before the ROS wheels' hook, which restarts Python with the library path set here.
            (site_packages / "_rotavg_workspace.pth").write_text(
                "import rotavg_workspace; rotavg_workspace.activate_this_process()\n"
            )
    return stale


# Tools


def ask_venv(code: str) -> list[str]:
    """The lines that a short program prints in the virtual environment; none if it fails."""
    answer = subprocess.run([str(VENV / "bin" / "python"), "-c", code], capture_output=True, text=True, check=False)
    return answer.stdout.splitlines()


def pip(*arguments: str | Path) -> None:
    """Run the environment's pip; a terminal shows in one line what it is at, an error brings all that it said."""
    command = [VENV / "bin" / "python", "-m", "pip", "--disable-pip-version-check", *arguments]
    # No warnings: setuptools warns of every editable installation.
    environ = {**clean_environment(), "PYTHONWARNINGS": "ignore"}
    said = []
    process = subprocess.Popen(
        command, cwd=ROOT, env=environ, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert process.stdout is not None
    with process:
        for line in process.stdout:
            said.append(line)
            if sys.stdout.isatty():
                print(f"\r\033[K       {line.strip()[:70]}", end="", flush=True)
    if sys.stdout.isatty():
        print("\r\033[K", end="", flush=True)
    if process.returncode != 0:
        sys.stderr.writelines(said)
        raise subprocess.CalledProcessError(process.returncode, ["pip", arguments[0]])


def colcon(*arguments: str, output: bool = False) -> str:
    command: list[str | Path] = [VENV / "bin" / "python", "-m", "colcon"]
    command += ["--log-base", "log", "--log-level", "error", *arguments]
    return run(command, clean_environment(), output)


def clean_environment() -> dict[str, str]:
    """The user's environment without any other ROS in it, with the virtual environment's tools first."""
    foreign = ("AMENT_", "CMAKE_", "COLCON_", "ROS_", "PYTHON", "VIRTUAL_ENV", "LD_LIBRARY_PATH", "_ROS_WHEELS")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
    path = f"{VENV / 'bin'}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    ours = {"PATH": path, "AMENT_PREFIX_PATH": str(VENV), "CMAKE_PREFIX_PATH": str(VENV), OPT_OUT: "1"}
    # Else colcon has make begin no second job while the load is as high as cores are many.
    return {**kept, **ours, "MAKEFLAGS": f"-j{len(os.sched_getaffinity(0))}"}


def run(command: list[str | Path], environ: dict[str, str] | None = None, output: bool = False) -> str:
    stdout = subprocess.PIPE if output else None
    return subprocess.run(command, cwd=ROOT, env=environ, check=True, text=True, stdout=stdout).stdout


def say(what: str) -> None:
    print(f"setup: {what}", flush=True)


@contextmanager
def only_one_setup() -> Iterator[None]:
    """Let a second set-up of the same tree wait for the first."""
    with open(STATE / "lock", "w", encoding="utf-8") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def stamp(name: str, inputs: Iterable[Path], outputs: Iterable[Path] = ()) -> Iterator[bool]:
    """Yield whether a step is stale: its inputs changed since it last succeeded, or an output is missing."""
    digest = hashlib.sha256(str(ROOT).encode())
    for file in inputs:
        digest.update(str(file.relative_to(ROOT)).encode() + b"\0")
        digest.update(file.read_bytes() if file.is_file() else b"")
    record = STATE / name
    stale = not (record.is_file() and record.read_text() == digest.hexdigest() and all(map(Path.exists, outputs)))
    if stale:
        record.unlink(missing_ok=True)
    yield stale
    record.write_text(digest.hexdigest())


def files_below(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())
