"""The sources that an answer may depend on are all found, and hardly any other."""

from __future__ import annotations

from pathlib import Path

import pytest

from rotavg_ros.evaluation.common import contenders, peers
from rotavg_ros.evaluation.common.source_files import source_files


def test_sources_behind_a_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "some_package"
    (package / "part" / "deeper").mkdir(parents=True)
    files = {
        "__init__.py": "from some_package import unused",
        "unused.py": "",
        "part/__init__.py": "from some_package.part import unused",
        "part/unused.py": "",
        "start.py": "import json\nfrom some_package.part.used import thing\ndef later():\n    import some_package.lazy",
        "part/used.py": "import some_package.start\nfrom some_package.part import also\nname = 'some_package.named'",
        "part/also.py": "from .deeper import face\nfrom ..part.deeper.inner import thing",
        "part/deeper/__init__.py": "from some_package.part.deeper.face_of_it import face",
        "part/deeper/face_of_it.py": "",
        "part/deeper/inner.py": "from . import sibling",
        "part/deeper/sibling.py": "",
        "part/deeper/unused.py": "",
        "lazy.py": "",
        "named.py": "'''some_package.part.unused is not used'''",
    }
    for name, text in files.items():
        (package / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    found = [str(path.relative_to(package)) for path in source_files("some_package.start")]
    passed_on_the_way = ("__init__.py", "part/__init__.py")
    assert found == sorted(name for name in files if name not in passed_on_the_way and "unused" not in name)
    with pytest.raises(ModuleNotFoundError):
        source_files("some_package.missing")


def test_what_the_top_of_a_package_gathers_counts_where_it_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "gathering_package"
    package.mkdir()
    (package / "__init__.py").write_text("names = {'solve': 'gathering_package.solver'}")
    (package / "solver.py").touch()
    (package / "start.py").write_text("from gathering_package import solve")
    monkeypatch.syspath_prepend(tmp_path)
    found = [path.name for path in source_files("gathering_package.start")]
    assert found == ["__init__.py", "solver.py", "start.py"]


def test_what_ours_and_the_peers_depend_on() -> None:
    ours, theirs = (set(map(str, source_files(module.__name__))) for module in (contenders, peers))

    def has(files: set[str], *parts: str) -> bool:
        return all(any(part in file for file in files) for part in parts)

    assert has(ours, "/baselines/weiszfeld.py", "/metrics/", "/solver/", "/slam/network.py", "network_store.py")
    assert has(theirs, "/baselines/start.py", "/peers/gtsam_peers.py", "spanning_forest.py", "/view_graph.py")
    for part in ("pipeline.py", "network_store.py", "clean_net.py", "/datasets/"):
        assert not has(theirs, part), part
