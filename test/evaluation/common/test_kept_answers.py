"""Answers that are kept are found again: for the same question alone, and while nothing they depend on has changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.simulation.synthetic import ReleasedRecipe
from rotavg_ros.evaluation.common import contenders as contenders_module
from rotavg_ros.evaluation.common import peers
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.contenders import contenders
from rotavg_ros.evaluation.common.kept_answers import KeptAnswers
from rotavg_ros.evaluation.sfm.contenders import ROSTER
from rotavg_ros.view_graph import ViewGraph

MODULES = (contenders_module.__name__,)


@pytest.fixture(scope="module")
def case() -> Case:
    sample = ReleasedRecipe(cameras=(20, 20)).sample(np.random.default_rng(1))
    return Case(CaseKey("any"), sample.graph, sample.body_from_world)


def test_a_case_is_solved_once(tmp_path: Path, case: Case) -> None:
    solved = []

    def contender(of: Case) -> Answer | None:
        solved.append(of)
        return None if of.key.name == "too large" else contenders(["neurora"], ROSTER)["neurora"](of)

    again = KeptAnswers(tmp_path).keeping(contender, "neurora", MODULES)
    first, second = again(case), KeptAnswers(tmp_path).keeping(contender, "neurora", MODULES)(case)
    assert first is not None and second is not None and len(solved) == 1
    torch.testing.assert_close(vars(first), vars(second), rtol=0, atol=0, equal_nan=True)
    large = replace(case, key=CaseKey("too large"))
    assert again(large) is None is again(large)
    assert len(solved) == 2
    measured = case.graph.target_from_source.clone()
    measured[0] = measured[1]
    again(replace(case, graph=replace(case.graph, target_from_source=measured)))
    KeptAnswers(tmp_path).keeping(contender, "spt", MODULES)(case)
    assert len(solved) == 4


def test_a_damaged_file_is_no_answer(tmp_path: Path, case: Case) -> None:
    """Cut anywhere, emptied, or with any byte changed: read as it was written, or solved again and written anew."""
    given = Answer(case.truth, 1.0, 2.0, outlier_score=torch.tensor([1.0, 0.0]))
    solved = []

    def solver(graph: ViewGraph) -> Answer:
        solved.append(graph)
        return given

    again = KeptAnswers(tmp_path).keeping(solver, "peer", (peers.__name__,))
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
        assert found.outlier_score is not None and found.outlier_score.tolist() == [1.0, 0.0]
        assert (found.seconds, found.cpu_seconds, found.uncertainty) == (1.0, 2.0, None)
    assert len(solved) > 4
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_an_answer_goes_when_a_source_behind_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: Case
) -> None:
    """However deep in the package the source lies."""
    deep = tmp_path / "answering_package" / "solver" / "slam" / "update"
    deep.mkdir(parents=True)
    for folder in (deep, *deep.parents[:3]):
        (folder / "__init__.py").touch()
    (tmp_path / "answering_package" / "start.py").write_text("from answering_package.solver.slam.update import step")
    (deep / "step.py").write_text("one")
    monkeypatch.syspath_prepend(tmp_path)
    solved = []

    def ask() -> None:
        KeptAnswers(tmp_path / "kept").keeping(solved.append, "any", ("answering_package.start",))(case)

    ask()
    ask()
    assert len(solved) == 1
    (deep / "step.py").write_text("two")
    ask()
    assert len(solved) == 2


def test_other_weights_are_other_networks(tmp_path: Path, case: Case) -> None:
    """Of our own methods, that is: no peer reads them. Weights count wherever they lie below their folder."""
    weights = tmp_path / "weights"
    (weights / "family").mkdir(parents=True)
    solved: list[str] = []

    def ask() -> None:
        keep = KeptAnswers(tmp_path / "kept", weights)
        keep.keeping(lambda _: solved.append("ours"), "ours", MODULES)(case)
        keep.keeping(lambda _: solved.append("theirs"), "theirs", (peers.__name__,))(case)

    ask()
    (weights / "family" / "some.safetensors").write_text("other weights")
    ask()
    assert solved == ["ours", "theirs", "ours"]


@pytest.mark.parametrize("folder", ["file", "file/below", "/proc/nowhere"])
def test_a_folder_that_cannot_be(folder: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    command = ["evaluate", "synthetic", "--output", str(tmp_path / "out"), "--keep", str(tmp_path / folder)]
    assert main(command) == 2
    assert capsys.readouterr().err.startswith(f"rotavg: error: {tmp_path / folder}: cannot be used as a folder (")
    assert (tmp_path / "file").read_text() == "mine"
