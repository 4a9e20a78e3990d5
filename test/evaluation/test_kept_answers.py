"""Answers that are kept are found again: for the same question alone, and while nothing they depend on has changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.simulation.synthetic import ReleasedRecipe
from rotavg_ros.evaluation import kept_answers, peers
from rotavg_ros.evaluation.contenders import Answer, Case, contenders
from rotavg_ros.evaluation.kept_answers import kept
from rotavg_ros.evaluation.peers import PeerAnswer
from rotavg_ros.evaluation.source_files import source_files
from rotavg_ros.solver import network_store
from rotavg_ros.view_graph import ViewGraph

MODULE = "rotavg_ros.evaluation.contenders"


@pytest.fixture(scope="module")
def case() -> Case:
    sample = ReleasedRecipe(cameras=(20, 20)).sample(np.random.default_rng(1))
    return Case("any", sample.graph, sample.body_from_world)


def test_a_case_is_solved_once(tmp_path: Path, case: Case) -> None:
    solved = []

    def contender(of: Case) -> Answer | None:
        solved.append(of)
        return None if of.name == "too large" else contenders(["neurora"])["neurora"](of)

    again = kept("neurora", contender, Answer, tmp_path, MODULE)
    first, second = again(case), kept("neurora", contender, Answer, tmp_path, MODULE)(case)
    assert first is not None and second is not None and len(solved) == 1
    assert torch.equal(first.body_from_world, second.body_from_world)
    assert torch.equal(first.outlier_score, second.outlier_score) and first.cpu_seconds == second.cpu_seconds
    assert again(replace(case, name="too large")) is None is again(replace(case, name="too large"))
    measured = case.graph.target_from_source.clone()
    measured[0] = measured[1]
    again(replace(case, graph=replace(case.graph, target_from_source=measured)))
    kept("spt", contender, Answer, tmp_path, MODULE)(case)
    assert len(solved) == 4
    assert kept("neurora", contender, Answer, None, MODULE) is contender


def test_a_damaged_file_is_no_answer(tmp_path: Path, case: Case) -> None:
    """Cut anywhere, emptied, or with any byte changed: read as it was written, or solved again and written anew."""
    given = PeerAnswer(case.truth, 1.0, 2.0, is_outlier=torch.tensor([True, False]))
    solved = []

    def solver(graph: ViewGraph) -> PeerAnswer:
        solved.append(graph)
        return given

    again = kept("peer", solver, PeerAnswer, tmp_path, peers.__name__)
    again(case.graph)
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    damages = [b"", b"not an archive", whole[: len(whole) // 2], whole[:-1]]
    for place in range(0, len(whole), 41):
        damages.append(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
    for damage in damages:
        path.write_bytes(damage)
        found = again(case.graph)
        assert found is not None and torch.equal(found.body_from_world, given.body_from_world), damage
        assert found.is_outlier is not None and found.is_outlier.tolist() == [True, False]
        assert (found.seconds, found.cpu_seconds, found.update_seconds) == (1.0, 2.0, None)
    assert len(solved) > 4
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_an_answer_goes_when_a_source_behind_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: Case
) -> None:
    source = tmp_path / "source.py"
    source.write_text("one")
    monkeypatch.setattr(kept_answers, "source_files", lambda module: (source,))
    solved = []

    def ask() -> None:
        kept_answers._version.cache_clear()  # as in a process of its own
        kept("any", solved.append, Answer, tmp_path / "kept", MODULE)(case)

    ask()
    ask()
    assert len(solved) == 1
    source.write_text("two")
    ask()
    assert len(solved) == 2
    kept_answers._version.cache_clear()


def test_other_weights_are_other_networks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some.safetensors").write_text("other weights")
    versions = {}
    for weights in (network_store.WEIGHTS_FOLDER, tmp_path):
        monkeypatch.setattr(network_store, "WEIGHTS_FOLDER", weights)
        kept_answers._version.cache_clear()
        versions[weights] = [kept_answers._version(module, ()) for module in (MODULE, peers.__name__)]
    kept_answers._version.cache_clear()
    (ours, theirs), (ours_then, theirs_then) = versions.values()
    assert ours != ours_then and theirs == theirs_then


def test_sources_behind_a_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "some_package"
    (package / "part").mkdir(parents=True)
    files = {
        "__init__.py": "from some_package import unused",
        "unused.py": "",
        "part/__init__.py": "from some_package.part import unused",
        "part/unused.py": "",
        "start.py": "import json\nfrom some_package.part.used import thing\ndef later():\n    import some_package.lazy",
        "part/used.py": "import some_package.start\nfrom some_package.part import also\nname = 'some_package.named'",
        "part/also.py": "",
        "lazy.py": "",
        "named.py": "from .. import nothing\n'''some_package.part.unused is not used'''",
    }
    for name, text in files.items():
        (package / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    found = [str(path.relative_to(package)) for path in source_files("some_package.start")]
    assert found == ["lazy.py", "named.py", "part/also.py", "part/used.py", "start.py"]
    with pytest.raises(ModuleNotFoundError):
        source_files("some_package.missing")


def test_what_ours_and_the_peers_depend_on() -> None:
    ours, theirs = ({f"{path.parent.name}/{path.name}" for path in source_files(m)} for m in (MODULE, peers.__name__))
    assert {"baselines/weiszfeld.py", "evaluation/metrics.py", "solver/slam_passes.py", "solver/tuning.py"} <= ours
    assert {"baselines/start.py", "evaluation/peers.py", "solver/spanning_tree.py", "solver/residuals.py"} <= theirs
    assert not {"solver/pipeline.py", "solver/slam_passes.py"} & theirs


@pytest.mark.parametrize("folder", ["file", "file/below", "/proc/nowhere"])
def test_a_folder_that_cannot_be(folder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    command = ["evaluate", "synthetic", "--output", str(tmp_path / "out"), "--keep", str(tmp_path / folder)]
    assert main(command) == 2
    assert capsys.readouterr().err.startswith(f"rotavg: error: {tmp_path / folder}: cannot be used as a folder (")
    assert (tmp_path / "file").read_text() == "mine"
