"""Makes every Python of the virtual environment see the workspace that colcon built next to it.

`make setup` copies this file into the environment's site-packages as `rotavg_workspace.py`, with a .pth file that
calls `activate_this_process` whenever an interpreter starts. It does what sourcing `install/setup.sh` would do, so that
`.venv/bin/rotavg_node` and `install/rotavg_ros/lib/rotavg_ros/rotavg_node` run without any variable set by the user.
Nothing in the package depends on it: where ROS 2 comes from apt, the workspace is sourced as usual.
"""

from __future__ import annotations

import os
import sys
from collections.abc import MutableMapping
from pathlib import Path

OPT_OUT = "ROTAVG_IGNORE_WORKSPACE"  # set while colcon builds the workspace, which must not see its own former result
_BOOTSTRAPPED = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"  # set by the ROS wheels once they restarted Python with library paths


def activate_this_process() -> None:
    """What the .pth file calls."""
    # `. install/setup.sh` has Python compute these very variables and must see the shell's own values.
    if not any("_local_setup_util" in argument for argument in sys.orig_argv[1:]):
        activate(Path(sys.prefix), os.environ, sys.path)


def activate(environment: Path, environ: MutableMapping[str, str], module_path: list[str]) -> None:
    """Add the workspace beside the virtual environment `environment` to `environ` and to `module_path` (sys.path).

    The workspace's packages come before the environment's own prefix, because pip leaves an ament marker without
    executables there. Calling it twice changes nothing.
    """
    install = environment.parent / "install"
    packages = [install / name for name in ("rotavg_ros", "rotavg_msgs") if (install / name).is_dir()]
    if OPT_OUT in environ or not packages:
        return
    prepend(environ, "AMENT_PREFIX_PATH", [*packages, environment])
    libraries = [package / "lib" for package in packages if any((package / "lib").glob("*.so"))]
    if prepend(environ, "LD_LIBRARY_PATH", libraries):
        # The dynamic loader reads the variable once, when a process starts: have the wheels restart Python (again).
        environ.pop(_BOOTSTRAPPED, None)
    for site_packages in install.glob(f"rotavg_msgs/lib/python3.{sys.version_info.minor}/site-packages"):
        if str(site_packages) not in module_path:
            module_path.append(str(site_packages))


def prepend(environ: MutableMapping[str, str], variable: str, folders: list[Path]) -> bool:
    """Put `folders` in front of a path variable, once each; True if one of them was not in it before."""
    before = [entry for entry in environ.get(variable, "").split(os.pathsep) if entry]
    wanted = [str(folder) for folder in folders]
    environ[variable] = os.pathsep.join(wanted + [entry for entry in before if entry not in wanted])
    return not set(wanted) <= set(before)
