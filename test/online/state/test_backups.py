"""What is forgotten or replaced lies beside the state file first."""

from __future__ import annotations

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rotavg_ros.errors import UserError
from rotavg_ros.online import Discarded, EstimatorOptions, OnlineEstimator
from rotavg_ros.online.state.backups import KEPT, backups

SECOND = 1_000_000_000
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, on_time_jump="reset")


def feed(estimator: OnlineEstimator, count: int, start_s: int = 1000) -> None:
    for index in range(count):
        assert estimator.add_odometry("r", (start_s + index) * SECOND, (0, 0, 0, 1), (9.0 + index, 0, 0)) is None


def loaded(path: Path, solver) -> int:
    estimator = OnlineEstimator(OPTIONS, solver)
    estimator.load(path)
    return estimator.counts().keyframes


@pytest.fixture
def discarded() -> list[Discarded]:
    return []


@pytest.fixture
def estimator(solver, discarded) -> OnlineEstimator:
    return OnlineEstimator(OPTIONS, solver, discarded.append)


def test_everything_that_is_lost_is_handed_over(estimator, solver, discarded, tmp_path) -> None:
    estimator.reset()
    assert discarded == [], "nothing was there"
    feed(estimator, 20)
    estimator.save(tmp_path / "state.npz")
    estimator.reset()
    feed(estimator, 30)
    estimator.load(tmp_path / "state.npz")
    feed(estimator, 12, 1020)
    for index in range(5):  # the stamps go back
        estimator.add_odometry("r", (500 + index) * SECOND, (0, 0, 0, 1))
    assert estimator.counts().keyframes == 5 and estimator.counts().time_jumps == 1
    estimator.clock_went_back(0)
    assert [each.num_keyframes for each in discarded] == [20, 30, 32, 5]
    kept = [each.back_up(tmp_path / "state.npz") for each in discarded]
    assert [loaded(path, solver) for path in kept] == [20, 30, 32, 5]
    assert backups(tmp_path / "state.npz") == kept[::-1]


def test_a_load_that_is_refused_replaces_nothing(estimator, discarded, tmp_path) -> None:
    feed(estimator, 5)
    (tmp_path / "state.npz").write_text("not a state")
    with pytest.raises(UserError):
        estimator.load(tmp_path / "state.npz")
    assert discarded == [] and estimator.counts().keyframes == 5


def test_of_many_backups_the_newest_and_the_largest_stay(estimator, solver, discarded, tmp_path) -> None:
    """A clock that goes back every few seconds must not push out the map of a whole day."""
    path = tmp_path / "state.npz"
    (tmp_path / "state.npz.bak-x").write_text("somebody else's")
    (tmp_path / "other.npz.bak-0009").write_text("of another node")
    sizes = [50, 900, 30, 40, 20, 60, 10, 70, 25, 15]
    for size in sizes:
        feed(estimator, size)
        estimator.reset()
        newest = discarded.pop().back_up(path)
        assert backups(path)[0] == newest
    assert sorted(loaded(each, solver) for each in backups(path)) == sorted([900, 70, 60, 50, 15])
    assert len(backups(path)) == KEPT and len(list(tmp_path.iterdir())) == KEPT + 2
    assert newest.name == "state.npz.bak-0010"


@contextmanager
def files_no_larger_than(size: int) -> Iterator[None]:
    """The nearest to a full disk that a test can make without one."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_on_a_full_disk_the_last_save_is_put_out_of_harms_way(estimator, solver, discarded, tmp_path) -> None:
    path = tmp_path / "state.npz"
    feed(estimator, 20)
    estimator.save(path)
    feed(estimator, 400, 1020)
    estimator.reset()
    with files_no_larger_than(path.stat().st_size // 2), pytest.raises(UserError, match=r"bak-0001") as failure:
        discarded[0].back_up(path)
    assert "cannot write the state file" in str(failure.value)
    feed(estimator, 3)
    estimator.save(path)  # as autosave would
    assert [loaded(each, solver) for each in (path, *backups(path))] == [3, 20]


def test_on_a_full_disk_without_an_earlier_save_it_only_says_so(estimator, discarded, tmp_path) -> None:
    feed(estimator, 200)
    estimator.reset()
    with files_no_larger_than(1000), pytest.raises(UserError, match="cannot write the state file"):
        discarded[0].back_up(tmp_path / "state.npz")
    assert list(tmp_path.iterdir()) == []
