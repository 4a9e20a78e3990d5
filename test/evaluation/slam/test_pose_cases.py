"""The suite of poses: its kinds, what is known of a case, and how answers are judged by place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D

from rotavg_ros import rotations
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, drawings
from rotavg_ros.evaluation.common.contenders import contenders
from rotavg_ros.evaluation.common.scoring import score
from rotavg_ros.evaluation.slam import pose_cases
from rotavg_ros.evaluation.slam.pose_contenders import ORACLE, PEERS, ROSTER, ROWS, TOLD


def no_data() -> Path:
    raise UserError("nobody should ask for the data")


def case_of(text: str, seed: int = 0) -> Case:
    return next(iter(drawings(pose_cases.kinds(no_data, [text]), [seed])))


def answer_of(name: str, case: Case) -> Answer:
    answer = contenders([name], ROSTER)[name](case)
    assert answer is not None
    return answer


def test_kinds_by_parts_of_their_names() -> None:
    names = [kind.name for kind in pose_cases.kinds(no_data, ["sparse BUILDING: "])]
    assert names == [f"sparse building: {condition}" for condition in pose_cases.CONDITIONS]
    with pytest.raises(pose_cases.PoseSuiteError, match=r"'nowhere'; names begin with B25b_0.000, "):
        pose_cases.kinds(no_data, ["hills", "nowhere"])
    with pytest.raises(UserError, match="nobody should ask"):
        pose_cases.kinds(no_data, ["CSAIL"])


def test_a_case_is_the_same_at_every_call() -> None:
    text = "sparse building: 30 % parallel corridors in runs"
    torch.testing.assert_close(case_of(text).graph.translation, case_of(text).graph.translation, rtol=0, atol=0)
    assert not torch.equal(case_of(text).truth, case_of(text, 1).truth)


def test_closures_are_false_by_place() -> None:
    case = case_of("sparse building: 30 % parallel corridors")
    assert case.intact is not None
    assert int(case.is_false.sum()) == int((~case.intact).sum()) > 10
    # By rotation alone none would be.
    assert not replace(case, poses=None).is_false.any()
    assert torch.equal(case.is_good, case.is_closure & case.intact)


def test_borders_of_what_is_judged() -> None:
    """One closure moved by so many metres: good, undecided on either side of 2 m, false."""
    case = case_of("sparse building: no false")
    assert case.poses is not None and case.graph.translation is not None
    edge = int(case.is_closure.nonzero()[0])
    rotation = case.truth[case.graph.source[edge]]
    ends = case.poses.position[case.graph.target[edge]] - case.poses.position[case.graph.source[edge]]
    exact = torch.from_numpy(pose_cases.Rotation.from_quat(rotation.numpy()).apply(ends.numpy()))
    verdicts = []
    for metres in (1.4, 1.6, 2.1, 3.9, 4.1):
        translation = case.graph.translation.clone()
        translation[edge] = exact + torch.tensor([metres, 0.0, 0.0])
        moved = replace(case, graph=replace(case.graph, translation=translation), intact=None)
        assert float(moved.place_error[edge]) == pytest.approx(metres)
        verdicts.append((bool(moved.is_good[edge]), bool(moved.is_false[edge]), bool(moved.is_inlier[edge])))
    undecided = (False, False)
    assert verdicts == [
        (True, False, True),
        (*undecided, True),
        (*undecided, False),
        (*undecided, False),
        (False, True, False),
    ]


def test_ate_is_evos() -> None:
    case = case_of("hills: no false")
    assert case.poses is not None
    answer = answer_of("odometry", case)
    assert answer.position is not None
    found = score(case, "odometry", answer)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (case.graph.num_nodes, 1))
    reference = PosePath3D(case.poses.position.numpy(), upright)
    estimate = PosePath3D(answer.position.numpy(), upright)
    estimate.align(reference)
    metric = APE(PoseRelation.translation_part)
    metric.process_data((reference, estimate))
    assert found.ate_m == pytest.approx(metric.get_all_statistics()["rmse"], abs=1e-9)
    assert found.floored_m == max(found.ate_m, 0.05)
    orientations_alone = score(case, "none", replace(answer, position=None))
    assert np.isnan(orientations_alone.ate_m)
    assert orientations_alone.mean_deg == found.mean_deg


@pytest.mark.parametrize("graph", [pytest.param("building", marks=pytest.mark.large), "hills"])
def test_the_oracle_is_near_the_truth_and_judges_rightly(graph: str) -> None:
    for case in drawings(pose_cases.kinds(no_data, [f"{graph}: 30"]), [0]):
        found = score(case, ORACLE, answer_of(ORACLE, case))
        assert found.ate_m < 0.5
        assert found.counts.precision == found.counts.recall == 1.0


def test_everyone_solves_the_tiny_case_and_says_so() -> None:
    pytest.importorskip("gtsam")
    case = pose_cases.tiny_case()
    for name, contender in contenders(list(ROWS), ROSTER).items():
        answer = contender(case)
        assert answer is not None and answer.position is not None and answer.outlier_score is not None, name
        assert float(answer.outlier_score.max()) < 0.5, name
        assert score(case, name, answer).ate_m < 0.1, name
    assert ROWS.keys() == TOLD.keys()
    assert set(PEERS) <= ROWS.keys()


@pytest.mark.large
def test_wrong_places_do_not_bend_the_positions() -> None:
    """Ours and the peers that are told the truth, beside the oracle; rotations alone flag none of them."""
    pytest.importorskip("gtsam")
    case = case_of("building: 30 % parallel corridors")
    scores = {
        name: score(case, name, answer_of(name, case))
        for name in ("neurora", "neurora-rotations", "gnc-true", "isam2-cauchy", "pcm", "odometry", ORACLE)
    }
    limit = 2 * scores[ORACLE].floored_m
    for name in ("neurora", "gnc-true", "isam2-cauchy", "pcm"):
        assert scores[name].floored_m < limit, name
        assert scores[name].counts.recall == 1.0, name
    assert scores["odometry"].ate_m > limit
    assert scores["neurora-rotations"].counts.recall < 0.1


def test_a_recorded_graph(shared_data: Path) -> None:
    (kind,) = pose_cases.kinds(lambda: shared_data, ["B25b_0.500"])
    case = kind.draw(0)
    assert case is not None and case.poses is not None
    assert not kind.is_random
    # By ground truth none of them is far off.
    assert not case.is_false.any()
    assert int(case.is_good.sum()) > 80
    assert case.poses.stated.shape == (case.graph.num_edges, 2)
    assert bool(torch.isfinite(case.poses.stated).all())


@pytest.mark.parametrize("name", pose_cases.RECORDED_NOISE)
def test_true_deviations_are_what_the_edges_of_a_recorded_graph_leave(shared_data: Path, name: str) -> None:
    case = next(drawings(pose_cases.kinds(lambda: shared_data, [name]), [0]))
    noise, good = pose_cases.RECORDED_NOISE[name], case.is_good
    assert float(case.noise[good].square().mean().sqrt()) == pytest.approx(np.radians(noise.closure_deg), rel=0.03)
    assert float((case.place_error[good].square().mean() / 2).sqrt()) == pytest.approx(noise.closure_m, rel=0.03)
    # Sums over 100 steps, in the world frame, in which the truth's own errors of the poses between cancel.
    turn, shift = residuals_of_steps(case)
    sums = [np.convolve(each, np.ones(100), mode="valid") / 10 for each in (turn, *shift.T)]
    known = np.isfinite(sums[0])
    turned, *shifted = (np.sqrt((each[known] ** 2).mean()) for each in sums)
    assert turned == pytest.approx(np.radians(noise.step_deg), rel=0.03)
    assert np.hypot(*shifted) / np.sqrt(2) == pytest.approx(noise.step_m, rel=0.03)


def residuals_of_steps(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """``(N - 1,)`` rad and ``(N - 1, 2)`` metres of a planar chain of odometry, NaN where the truth is unknown."""
    graph, poses = case.graph.select_edges(case.graph.is_odometry), case.poses
    assert poses is not None and graph.translation is not None
    assert torch.equal(graph.source, torch.arange(graph.num_nodes - 1)) and torch.equal(graph.target, graph.source + 1)
    source, target = case.truth[graph.source], case.truth[graph.target]
    turn = rotations.multiply(rotations.inverse(target), rotations.multiply(graph.target_from_source, source))
    moved = poses.position[graph.target] - poses.position[graph.source]
    shift = moved - rotations.rotate(rotations.inverse(source), graph.translation)
    return rotations.log(turn)[:, 2].numpy(), shift[:, :2].numpy()


def test_a_classic_graph_is_drawn_anew(shared_data: Path) -> None:
    clean, spoiled = drawings(pose_cases.kinds(lambda: shared_data, ["CSAIL: no", "CSAIL: 30 % random"]), [0])
    assert (clean.graph.num_nodes, clean.graph.num_edges) == (1045, 1172)
    assert spoiled.graph.num_edges == 1172 + round(128 * 3 / 7)
    assert clean.poses is not None
    closures = clean.is_closure
    turn, metres = clean.noise[closures], clean.place_error[closures]
    noise = pose_cases.CLASSIC_NOISE["CSAIL"]
    assert float(turn.square().mean().sqrt()) == pytest.approx(np.radians(noise.closure_deg), rel=0.2)
    assert float((metres.square().mean() / 2).sqrt()) == pytest.approx(noise.closure_m, rel=0.2)
    # What they state is what the file states.
    assert float(clean.graph.precision[closures].rsqrt().median()) == pytest.approx(np.radians(1.6), rel=0.05)
