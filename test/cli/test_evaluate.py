from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.io import savemat

from rotavg_ros import rotations
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import write_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.evaluation.common.cases import Case, Kind
from rotavg_ros.evaluation.common.named_peers import is_available
from rotavg_ros.evaluation.common.training_plot import read_log
from rotavg_ros.evaluation.sfm import robustness, robustness_training, synthetic
from rotavg_ros.evaluation.sfm.published import Configuration
from rotavg_ros.training.trainer import Trainer


def test_synthetic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(synthetic.RECIPES, "paper", PaperRecipe(cameras=(30, 40)))
    monkeypatch.setitem(synthetic.RECIPES, "released-spatial", ReleasedRecipe(cameras=(30, 40), planar=False))
    methods = ["neurora", "cleannet-spt-paper+chatterjee", "spt", "oracle"]
    command = ["evaluate", "synthetic", "--graphs", "2", "--output", str(tmp_path / "results"), "--threads", "1"]
    assert main([*command, "--recipes", "paper", "released-spatial", "--methods", *methods]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'results' / 'synthetic.md'}\n"
    report = (tmp_path / "results" / "synthetic.md").read_text()
    assert "| **full pipeline** (our networks + refinement) |" in report
    assert "CleanNet-SPT + chatterjee" in report
    for file in tmp_path.glob("results/*.png"):
        assert f"({file.name})" in report
        assert file.read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "results" / "synthetic-paper-graphs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == methods * 2
    assert all(float(row["mean_deg"]) >= 0 for row in rows)


def test_few_graphs_do_for_what_is_slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(synthetic.RECIPES, "paper", PaperRecipe(cameras=(30, 40)))
    monkeypatch.setattr(synthetic, "CORE", ("neurora", "oracle"))
    rows = {name: synthetic.ROWS[name] for name in ("neurora", "spt", "oracle", "oracle-shaped")}
    monkeypatch.setattr(synthetic, "ROWS", rows)
    command = ["evaluate", "synthetic", "--graphs", "3", "--few-graphs", "2", "--recipes", "paper", "--threads", "1"]
    assert main([*command, "--output", str(tmp_path)]) == 0
    report = (tmp_path / "synthetic-paper.md").read_text()
    assert "3 graphs." in report
    assert "2 graphs." in report
    with (tmp_path / "synthetic-paper-few.csv").open() as file:
        few = {row["method"]: float(row["mean °"]) for row in csv.DictReader(file)}
    assert list(few) == list(rows.values())
    with (tmp_path / "synthetic-paper-graphs.csv").open() as file:
        graphs = [row for row in csv.DictReader(file) if row["method"] == "oracle"]
    assert len(graphs) == 3
    assert few[rows["oracle"]] == pytest.approx(np.mean([float(row["mean_deg"]) for row in graphs[:2]]), rel=1e-4)


@pytest.fixture
def tiny_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of the ten rows, of small graphs."""
    trained, tested = Configuration(20, 50, 10, 5, True), Configuration(30, 50, 10, 5, False)
    for name in ("planar", "in-space"):
        row = robustness.SETTINGS[name]._replace(varied=name, trained=trained, tested=tested)
        monkeypatch.setitem(robustness.SETTINGS, name, row)
    monkeypatch.setattr(robustness_training, "_MOST_GRAPHS", 2)


@pytest.mark.large
@pytest.mark.usefixtures("tiny_rows")
def test_robustness(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ["evaluate", "robustness", "--graphs", "1", "--minutes", "0.001", "--keep", str(tmp_path / "keep")]
    command += ["--output", str(tmp_path), "--threads", "1"]
    assert main([*command, "--settings", "in-space"]) == 0
    with (tmp_path / "robustness.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10 * 3
    assert [row["graphs"] for row in rows] == [*["not run"] * 24, *["1"] * 3, *["not run"] * 3]
    by_method = {row["method"]: row for row in rows[24:27]}
    assert len({row["mean °"] for row in by_method.values()}) == 3
    # The paper's figures stand beside the methods that it has.
    theirs = [row["paper: mean °"] for row in by_method.values()]
    assert theirs == ["2.2", "0.9", ""]
    report = (tmp_path / "robustness.md").read_text()
    assert "`rotavg evaluate robustness --threads 1 --graphs 1 --settings in-space --minutes 0.001`" in report
    assert (tmp_path / "robustness-training.png").read_bytes().startswith(b"\x89PNG")
    with (tmp_path / "robustness-curves.csv").open() as file:
        assert [row["network"] for row in csv.DictReader(file)] == ["paper-clean-net", "paper-fine-net"]

    # What has been trained is not trained again, for another row either.
    monkeypatch.setattr(Trainer, "run", None)
    assert main([*command, "--settings", "planar", "in-space"]) == 0
    with (tmp_path / "robustness.csv").open() as file:
        again = list(csv.DictReader(file))[24:]
    assert [row["mean °"] for row in again] == [row["mean °"] for row in rows[24:27]] * 2


@pytest.mark.large
@pytest.mark.usefixtures("tiny_rows")
def test_the_page_of_robustness_is_there_after_every_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interruption in the second row leaves the first, and no third is begun."""
    kind, drawn = robustness.kind, []

    def interrupted_at_second(configuration: Configuration, seed: int) -> Kind:
        drawn.append(configuration)
        return kind(configuration, seed) if len(drawn) == 1 else Kind("", interrupt)

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(robustness, "kind", interrupted_at_second)
    command = ["evaluate", "robustness", "--graphs", "1", "--minutes", "0.001", "--threads", "1"]
    assert main([*command, "--output", str(tmp_path), "--settings", "in-space", "planar", "in-space"]) == 0
    assert len(drawn) == 2
    assert (tmp_path / "robustness.md").read_text().count("| not run |") == 27


@pytest.mark.usefixtures("tiny_rows")
@pytest.mark.large
def test_what_was_solved_of_a_row_that_was_interrupted_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the page has said before that the row was not run."""
    kind = robustness.kind

    def of_one_graph(configuration: Configuration, seed: int) -> Kind:
        whole = kind(configuration, seed)

        def draw(number: int) -> Case | None:
            if number > 0:
                raise KeyboardInterrupt
            return whole.draw(number)

        return Kind(whole.name, draw)

    command = ["evaluate", "robustness", "--minutes", "0.001", "--threads", "1", "--output", str(tmp_path)]
    assert main([*command, "--graphs", "1", "--settings", "in-space"]) == 0
    monkeypatch.setattr(robustness, "kind", of_one_graph)
    assert main([*command, "--graphs", "2", "--settings", "planar"]) == 0
    with (tmp_path / "robustness.csv").open() as file:
        assert [row["graphs"] for row in csv.DictReader(file)][24:] == ["1"] * 6


@pytest.mark.usefixtures("tiny_rows")
@pytest.mark.large
def test_the_page_of_robustness_keeps_what_other_runs_have_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each row takes an hour."""
    command = ["evaluate", "robustness", "--minutes", "0.001", "--threads", "1", "--output", str(tmp_path)]
    command += ["--settings"]

    def page(*words: str) -> dict[str, list[list[str]]]:
        assert main([*command, *words]) == 0
        found = {}
        for name in ("", "-training", "-curves"):
            with (tmp_path / f"robustness{name}.csv").open() as file:
                found[name] = list(csv.reader(file))[1:]
        return found

    first = page("in-space", "--graphs", "1")
    other = Configuration(20, 60, 10, 5, True)
    monkeypatch.setitem(robustness.SETTINGS, "planar", robustness.SETTINGS["planar"]._replace(trained=other))
    second = page("planar", "--graphs", "2")
    assert second[""][24:27] == first[""][24:27]
    assert [row[-1] for row in second[""]] == [*["not run"] * 24, *["1"] * 3, *["2"] * 3]
    for name in ("-training", "-curves"):
        assert second[name][: len(first[name])] == first[name]
        assert len(second[name]) == 2 * len(first[name])
    # A file that is empty, or none of ours, is no row.
    for name, text in (("", ""), ("-training", "nonsense"), ("-curves", "\0")):
        (tmp_path / f"robustness{name}.csv").write_text(text)
    again = page("in-space", "--graphs", "1")
    assert [row[-1] for row in again[""]] == [*["not run"] * 24, *["1"] * 3, *["not run"] * 3]
    assert len(again["-training"]) == 1
    page("planar", "--graphs", "2")
    # And what is run again is what is shown.
    third = page("in-space", "--graphs", "3")
    assert [row[-1] for row in third[""]][24:] == [*["3"] * 3, *["2"] * 3]
    assert len(third["-training"]) == 2 and len(third["-curves"]) == 4


def test_real(tmp_path: Path) -> None:
    """Every table, of graphs in the formats of the real ones."""
    sample = ReleasedRecipe(cameras=(20, 20), noise_deg=(1, 1), outlier_share=(0, 0)).sample(np.random.default_rng(0))
    graph = sample.graph
    ends = graph.source.numpy(), graph.target.numpy()
    sfm = tmp_path / "sfm"
    (sfm / "topology").mkdir(parents=True)
    blocks = np.zeros((20, 3, 20, 3))
    blocks[ends[0], :, ends[1]] = rotations.to_matrix(graph.target_from_source).numpy()
    truth = rotations.to_matrix(sample.body_from_world).numpy()
    savemat(sfm / "lund_sphinx.mat", {"Rgt": truth.reshape(60, 3), "Rrel": blocks.reshape(60, 60)})
    (sfm / "madrid_metropolis").mkdir()
    write_graph(sfm / "madrid_metropolis" / "EGs.txt", GraphFile(graph, np.arange(20)))
    np.savez(sfm / "topology" / "Square.npz", nodes=20, source=ends[0], target=ends[1])
    command = ["evaluate", "real", "--data", str(tmp_path), "--output", str(tmp_path / "results"), "--threads", "1"]
    assert main([*command, "--methods", "spt", "neurora"]) == 0
    report = (tmp_path / "results" / "real.md").read_text()
    for title in ("Lund", "released recipe", "σ 0.5–3°", "Madrid"):
        assert title in report
    with (tmp_path / "results" / "real-topologies-2-graphs.csv").open() as file:
        assert [row["graph"] for row in csv.DictReader(file)] == ["Square"] * 2
    with (tmp_path / "results" / "real-lund.csv").open() as file:
        errors = {row["method"]: float(row["mean °"]) for row in csv.DictReader(file)}
    assert errors["neurora"] < 0.9 * errors["spt"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["synthetic", "--methods", "magic"], "unknown method 'magic'"),
        (["synthetic", "--graphs", "0"], "must be 1 or more"),
        (["synthetic", "--seed", "-1"], "must be 0 or more"),
        (["robustness", "--settings", "odd"], "odd"),
        (["robustness", "--minutes", "0"], "must be positive"),
        (["real"], "--data or $ROTAVG_DATA"),
        (["real", "--data", "nowhere"], "nowhere: lacks sfm/lund_sphinx.mat"),
        (["rgbd", "--data", "nowhere"], "nowhere: lacks rgbd/scannet_fgr"),
        (["everything"], "everything"),
    ],
)
def test_mistakes_take_one_line(
    words: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("ROTAVG_DATA", raising=False)
    assert main(["evaluate", *words, "--output", str(tmp_path / "results")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("rotavg: error: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("knows_truth", [True, False])
def test_plot_statistics(knows_truth: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = ReleasedRecipe(cameras=(30, 30)).sample(np.random.default_rng(0))
    truth = sample.body_from_world.numpy() if knows_truth else None
    write_graph(tmp_path / "graph.npz", GraphFile(sample.graph, np.arange(30), body_from_world_gt=truth))
    picture = tmp_path / "picture.png"
    assert main(["plot", "statistics", str(tmp_path / "graph.npz"), "--output", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["plot", "statistics", str(tmp_path / "none.npz")]) == 2


@pytest.mark.parametrize("kind", ["statistics", "training"])
@pytest.mark.parametrize(
    ("name", "told"),
    [("x.what", "unknown suffix '.what'; use .png"), ("none/x.png", "there is no folder"), ("", "is a")],
)
def test_a_picture_that_cannot_be_written_is_told_of_before_any_work(
    kind: str, name: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not even the graph is read: there is none."""
    assert main(["plot", kind, str(tmp_path / "none.npz"), "--output", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"rotavg: error: {tmp_path / name}: {told}") and error.count("\n") == 1


def test_plot_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, picture = tmp_path / "net.log.jsonl", tmp_path / "picture.png"
    log.write_text("".join(f'{{"epoch": {epoch}, "validation_objective": {2 / (epoch + 1)}}}\n' for epoch in range(5)))
    assert main(["plot", "training", str(log), str(log), "--output", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["plot", "training", str(log), "--output", str(tmp_path / "other")]) == 0
    assert capsys.readouterr().out.splitlines() == [str(picture), str(tmp_path / "other.png")]
    assert (tmp_path / "other.png").exists()
    epochs, objective = read_log(log)
    np.testing.assert_allclose(epochs * objective, 2)
    log.write_text('{"epoch": 1}\n')
    assert main(["plot", "training", str(log), "--output", str(picture)]) == 2
    assert "net.log.jsonl: not a log of training" in capsys.readouterr().err
    assert main(["plot", "training", str(tmp_path / "none"), "--output", str(picture)]) == 2


def test_names_in_pictures_are_no_mathematics(tmp_path: Path) -> None:
    graph, log = tmp_path / "a$_$b.g2o", tmp_path / "a$_$b.log.jsonl"
    graph.write_text("EDGE_SE2 0 1 1 0 0.1 1 0 0 1 0 1\n")
    log.write_text('{"epoch": 0, "validation_objective": 1}\n')
    for kind, read in (("statistics", graph), ("training", log)):
        picture = tmp_path / f"{kind}.png"
        assert main(["plot", kind, str(read), "--output", str(picture)]) == 0
        assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_picture_is_named_after_a_graph_with_dots_in_its_name(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.v2.g2o").write_text("EDGE_SE2 0 1 1 0 0.1 1 0 0 1 0 1\n")
    assert main(["plot", "statistics", "run.v2.g2o"]) == 0
    assert capsys.readouterr().out == "run.v2-statistics.png\n"
    assert Path("run.v2-statistics.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("kind", ["statistics", "training"])
@pytest.mark.parametrize("folder", [".", "/", "pictures"])
def test_a_picture_is_no_folder(kind: str, folder: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pictures").mkdir()
    Path("graph.g2o").write_text("EDGE_SE2 0 1 1 0 0.1 1 0 0 1 0 1\n")
    Path("log").write_text("".join(f'{{"epoch": {epoch}, "validation_objective": 1}}\n' for epoch in range(5)))
    read = {"statistics": "graph.g2o", "training": "log"}[kind]
    assert main(["plot", kind, read, "--output", folder]) == 2
    assert f"rotavg: error: {folder}: is a folder; give --output a picture's name" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"pictures", "graph.g2o", "log"}


@pytest.mark.large
def test_rgbd(tmp_path: Path) -> None:
    """Two folds of two scenes each; what is trained differs from the package's networks, which run beside it."""
    folder = tmp_path / "rgbd" / "redwood_fgr"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    for number in range(4):
        sample = ReleasedRecipe(cameras=(14, 14)).sample(rng)
        graph = sample.graph
        np.savez(
            folder / f"{number}.npz",
            source=graph.source.numpy(),
            target=graph.target.numpy(),
            target_from_source=graph.target_from_source.numpy(),
            registration_rms=np.ones(graph.num_edges),
            body_from_world_gt=sample.body_from_world.numpy(),
        )
    keep = tmp_path / "kept"
    command = ["evaluate", "rgbd", "--data", str(tmp_path), "--sets", "redwood_fgr", "--folds", "2"]
    command += ["--minutes", "0.001", "--output", str(tmp_path), "--keep", str(keep), "--threads", "1"]
    assert main(command) == 0
    report = (tmp_path / "rgbd.md").read_text()
    assert "`rotavg evaluate rgbd --threads 1 --sets redwood_fgr --folds 2 --minutes 0.001`: " in report
    with (tmp_path / "rgbd-redwood_fgr.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    # GTSAM's Shonan begins anywhere, and gives up now and then.
    assert {row["scenes"] for method, row in rows.items() if method != "shonan"} == {"4"}
    assert rows["neurora-v1"]["mean °"] != rows["package: neurora-v1"]["mean °"]
    of_package = Counter(path.name.rpartition("-")[0] for path in keep.iterdir())
    ours = ("chatterjee", "weiszfeld", "geman-mcclure", "oracle")
    ours += ("neurora-equal-precisions", "neurora-without-consensus")
    peers = [name for name in ("colmap", "shonan") if is_available(name)]
    assert of_package == dict.fromkeys((*ours, *peers, "cleannet-spt", "neurora-v1", "neurora"), 4)


def test_plot_statistics_of_a_truth_that_knows_too_little(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    graph, truth = tmp_path / "chain.g2o", tmp_path / "truth.csv"
    graph.write_text("".join(f"EDGE_SE2 {i} {i + 1} 1 0 0.1 1 0 0 1 0 1\n" for i in range(4)))
    command = ["plot", "statistics", str(graph), "--truth", str(truth), "--output", str(tmp_path / "a.png")]
    truth.write_text("id,qx,qy,qz,qw\n0,0,0,0,1\n2,0,0,0,1\n")
    assert main(command) == 2
    assert f"{truth}: knows the orientations of both ends of no edge" in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()
    truth.write_text("id,qx,qy,qz,qw\n0,0,0,0,1\n1,0,0,0,1\n")
    said: list[str] = []
    text = Figure.text
    monkeypatch.setattr(Figure, "text", lambda self, x, y, s, **look: (said.append(s), text(self, x, y, s, **look)))
    assert main(command) == 0
    assert said[1].startswith("1 of 4 edges, noise against the truth")
