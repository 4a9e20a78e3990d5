"""The source files of its package that a module's answers may depend on."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path


def source_files(module: str) -> tuple[Path, ...]:
    """The module's file and those of all modules of its package that it reaches through imports, sorted.

    Packages may be nested to any depth, and an imported package counts with everything that its ``__init__`` reaches.
    Imports inside functions and relative imports count, and so does any string that is the name of a module, since it
    may be imported by name. A package that is only on the path of an import (``a.b`` in ``from a.b.c import d``) does
    not count: through what it collects for others, every module would depend on all.

    Args:
        module: dotted name, as in ``__name__``.

    Raises:
        ModuleNotFoundError: there is no source file of that name.
    """
    package = module.partition(".")[0]
    spec = importlib.util.find_spec(package)
    folder = Path() if spec is None or spec.origin is None else Path(spec.origin).parent
    found: set[Path] = set()
    waiting = [module]
    while waiting:
        file = _file(folder, waiting.pop())
        if file is not None and file not in found:
            found.add(file)
            waiting += _names(file, folder)
    if not found:
        raise ModuleNotFoundError(f"no source file of a module named {module!r}", name=module)
    return tuple(sorted(found))


def _file(package_folder: Path, module: str) -> Path | None:
    path = package_folder.joinpath(*module.split(".")[1:])
    return next((file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file()), None)


def _names(file: Path, package_folder: Path) -> Iterator[str]:
    """Dotted names of the package that a file mentions: of modules, and of what is in them."""
    package = package_folder.name
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = _origin(node, file, package_folder)
            names = [f"{origin}.{alias.name}" for alias in node.names]
            if not all(name.startswith(f"{package}.") and _file(package_folder, name) for name in names):
                names.append(origin)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value != package:
            names = [node.value]
        yield from (name for name in names if re.fullmatch(rf"{package}(\.\w+)*", name))


def _origin(node: ast.ImportFrom, file: Path, package_folder: Path) -> str:
    """Dotted name of what is imported from; relative ones count from the file's package."""
    named = [node.module] if node.module else []
    if node.level == 0:
        return ".".join(named)
    place = file.parent.relative_to(package_folder.parent).parts
    return ".".join((*place[: len(place) - node.level + 1], *named))
