"""Repair of the CMake targets that the ROS wheels export.

The wheels were built in a manylinux container, and their exported targets still name that container's include folders
(`/opt/python/cp311-cp311/include/python3.11` and numpy's below it). CMake refuses a target whose include folders are
missing, so they are pointed at those of the interpreter in use.
"""

from __future__ import annotations

import re
from pathlib import Path

_CONTAINER = r"/opt/python/cp3\d+-cp3\d+t?"
_NUMPY_INCLUDE = re.compile(_CONTAINER + r"/lib/python3\.\d+t?/site-packages/numpy/(?:_core|core)/include")
_PYTHON_INCLUDE = re.compile(_CONTAINER + r"/include/python3\.\d+t?")


def repair_cmake_exports(prefix: Path, python_include: Path, numpy_include: Path) -> int:
    """Point the exported targets below `prefix`/share at this interpreter's include folders.

    Only files that name the container are changed, so that a second call changes nothing. Returns their number.
    """
    changed = 0
    for export in sorted(prefix.glob("share/*/cmake/*.cmake")):
        text = export.read_text(encoding="utf-8")
        repaired = _NUMPY_INCLUDE.sub(lambda _: str(numpy_include), text)
        repaired = _PYTHON_INCLUDE.sub(lambda _: str(python_include), repaired)
        if repaired != text:
            export.write_text(repaired, encoding="utf-8")
            changed += 1
    return changed
