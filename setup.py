"""Build description for both colcon (ament_python) and pip."""

from __future__ import annotations

import runpy
from pathlib import Path

from setuptools import find_packages, setup

NAME = "rotavg_ros"
ROOT = Path(__file__).resolve().parent  # resolved, because `colcon build --symlink-install` runs a link to this file
# Read from the file, not by import: the package needs torch, a build does not.
VERSION = runpy.run_path(str(ROOT / NAME / "version.py"))["__version__"]


def requirements(file_name: str) -> list[str]:
    """The requirements in a pip requirement file, without its comments."""
    lines = (ROOT / file_name).read_text(encoding="utf-8").splitlines()
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def resources() -> list[str]:
    """Files of resource/ that are installed for the user (RViz and Foxglove layouts), relative to this file."""
    return [str(path.relative_to(ROOT)) for path in sorted((ROOT / "resource").glob("*.*"))]


def message_definitions() -> list[str]:
    """The .msg files of rotavg_msgs, for reading and writing bags where no ROS is installed, relative to this file."""
    return [str(path.relative_to(ROOT)) for path in sorted((ROOT / "msg_defs" / "msg").glob("*.msg"))]


setup(
    name=NAME,
    version=VERSION,
    description="Rotation averaging with learned outlier rejection, as a ROS 2 node, a command line tool and a library",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(where=str(ROOT), include=[NAME, f"{NAME}.*"]),
    package_data={
        NAME: ["py.typed"],
        f"{NAME}.reports": ["templates/*.html"],
        f"{NAME}.solver": ["weights/*.safetensors", "weights/*.json"],
        f"{NAME}.training": ["configs/*.yaml"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/resource", resources()),
        (f"share/{NAME}/msg", message_definitions()),
    ],
    install_requires=requirements("requirements/runtime.txt"),
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "rotavg = rotavg_ros.cli.main:main",
            "rotavg_node = rotavg_ros.ros.node.main:main",
        ],
    },
)
