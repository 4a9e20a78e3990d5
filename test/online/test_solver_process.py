"""Solves in a process of their own: the same answers, memories, errors and ends."""

from __future__ import annotations

import errno
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import solve
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.errors import UserError
from rotavg_ros.odometry_route import Routes
from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.online.solver_process import client as client_module
from rotavg_ros.online.solver_process import server as server_module
from rotavg_ros.online.solver_process.client import SolverProcess
from rotavg_ros.online.solver_process.process import Spawned
from rotavg_ros.online.solver_process.wire import Request, to_arrays
from rotavg_ros.solver import Abandoned, abandonable
from rotavg_ros.view_graph import ViewGraph

OPTIONS = {"method": "neurora", "profile": "auto", "device": "cpu", "refinement_steps": None}


@pytest.fixture(scope="module")
def process() -> Iterator[SolverProcess]:
    solver = SolverProcess(threads=1)
    yield solver
    solver.close()
    assert not os.path.exists(f"/proc/{solver.pid}")


def graph(num_keyframes: int = 300) -> ViewGraph:
    simulated = simulate_slam_graph(
        SlamSimulationConfig(num_keyframes=num_keyframes, false_share=0.3), np.random.default_rng(0)
    )
    return simulated.graph


def grown(whole: ViewGraph, num_nodes: int) -> ViewGraph:
    """The graph as it was with fewer nodes."""
    kept = whole.select_edges((whole.source < num_nodes) & (whole.target < num_nodes))
    return replace(kept, num_nodes=num_nodes)


def test_solutions_are_those_of_this_process(process):
    whole = graph()
    here, there = solve(whole, **OPTIONS), process(whole, **OPTIONS)
    for name in ("body_from_world", "outlier_score", "component", "uncertainty"):
        ours, theirs = getattr(here, name), getattr(there, name)
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(theirs.numpy(), ours.numpy(), atol=1e-9)
    assert (there.method, there.profile, there.device, there.warnings) == (
        here.method,
        here.profile,
        here.device,
        here.warnings,
    )


def test_routes_are_told_once_and_again_when_they_change(process, monkeypatch):
    run = simulate_slam_graph(SlamSimulationConfig(num_keyframes=60, laps=2, false_share=0.0), np.random.default_rng(0))
    whole = replace(run.graph, translation=torch.from_numpy(run.edge_translation))
    route = torch.full((whole.num_edges,), -1)
    middle = int(torch.nonzero(whole.is_odometry)[30, 0])
    route[middle] = 0
    displacement = whole.translation[middle].numpy()[None]
    even = Routes.even(np.array([0.5]), displacement, np.array([3.0])).columns
    told, dumps = [], pickle.dumps
    monkeypatch.setattr(pickle, "dumps", lambda request, **how: told.append(request.graph) or dumps(request, **how))
    first, other = torch.from_numpy(even), torch.from_numpy(4 * even)
    answers = []
    for table in (first, first, other):
        several = replace(whole, route=route, routes=table, steps=torch.where(route >= 0, 3.0, 1.0).double())
        here, there = solve(several, **OPTIONS), process(several, **OPTIONS)
        torch.testing.assert_close(here.position, there.position, rtol=0, atol=0)
        answers.append(there.position)
    assert [isinstance(fields["routes"], str) for fields in told] == [False, True, False]
    assert torch.equal(answers[0], answers[1]) and not torch.allclose(answers[1], answers[2], rtol=0, atol=1e-9)


def test_it_remembers_its_last_solution_and_of_others_only_the_labels_are_left(process, monkeypatch):
    whole = graph()
    first = process(grown(whole, 298), **OPTIONS)
    start = torch.cat((first.body_from_world, first.body_from_world[-1:]))
    second = process(grown(whole, 299), warm_start=start, memory=first.memory, **OPTIONS)
    assert "update" in second.stage_seconds
    requests, dumps = [], pickle.dumps
    monkeypatch.setattr(pickle, "dumps", lambda request, **how: requests.append(request) or dumps(request, **how))
    for memory in (second.memory, first.memory):
        again = process(grown(whole, 299), warm_start=start, memory=memory, **OPTIONS)
        assert "update" in again.stage_seconds
    assert [request.remembered is not None for request in requests] == [True, False]
    assert [request.labels is not None for request in requests] == [False, True]


def test_mistakes_are_told_as_in_this_process(process):
    with pytest.raises(UserError, match="unknown method 'nonsense'; choose from"):
        process(graph(), **(OPTIONS | {"method": "nonsense"}))
    process(graph(30), **OPTIONS)


def test_a_solve_that_nobody_wants_ends_soon_and_the_next_one_is_right(process):
    whole = graph(3000)
    unwanted = threading.Event()
    threading.Timer(0.2, unwanted.set).start()

    def solve_on() -> None:
        while True:  # however fast it is, one of them is under way when the time has come
            process(whole, **OPTIONS)

    with pytest.raises(Abandoned), abandonable(unwanted.is_set):
        solve_on()
    small = graph(30)
    there = process(small, **OPTIONS)
    np.testing.assert_allclose(there.body_from_world.numpy(), solve(small, **OPTIONS).body_from_world.numpy())


class _Unseen:
    """A connection on which whoever waits does not see at first that the answer has come."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self.closed, self._has_looked = connection, False, False

    def poll(self, timeout: float) -> bool:
        if timeout == 0:  # whether it is alive
            return False
        while not self._connection.poll(timeout):
            pass
        seen, self._has_looked = self._has_looked, True
        return seen

    def __getattr__(self, name: str) -> object:
        return getattr(self._connection, name)


def test_a_solve_that_is_abandoned_just_as_it_ends_leaves_the_next_one_the_labels(process, monkeypatch):
    whole = graph()
    first = process(grown(whole, 298), **OPTIONS)
    start = torch.cat((first.body_from_world, first.body_from_world[-1:]))
    connection = process._process.connection
    monkeypatch.setattr(process._process, "connection", _Unseen(connection))
    with pytest.raises(Abandoned), abandonable(lambda: True):
        process(grown(whole, 299), warm_start=start, memory=first.memory, **OPTIONS)
    monkeypatch.setattr(process._process, "connection", connection)
    second = process(grown(whole, 299), warm_start=start, memory=first.memory, **OPTIONS)
    assert set(second.stage_seconds) == {"update"}
    assert ((first.outlier_score > 0.5) != (second.outlier_score[: len(first.outlier_score)] > 0.5)).sum() <= 1


def test_a_process_that_dies_is_an_error_and_the_next_solve_starts_another():
    solver = SolverProcess(threads=1)
    try:
        small = graph(30)
        solver(small, **OPTIONS)
        before = solver.pid
        os.kill(before, signal.SIGKILL)
        while solver.is_alive:  # until this side can know
            time.sleep(0.01)
        assert solver(small, **OPTIONS).method == "neurora"
        assert solver.pid != before
        large = graph(6000)
        threading.Timer(0.3, os.kill, (solver.pid, signal.SIGKILL)).start()
        with pytest.raises(UserError, match=r"the solver's process has died \(exit code -9"):
            solver(large, **OPTIONS)
    finally:
        solver.close()


def kill(solver: SolverProcess) -> None:
    """End its process as a lack of memory does, and wait until this side can know."""
    os.kill(solver.pid, signal.SIGKILL)
    while solver.is_alive:
        time.sleep(0.01)


def test_a_process_that_cannot_be_started_is_an_error_and_each_solve_tries_again(monkeypatch):
    solver, small, fails = SolverProcess(threads=1), graph(30), [True, True, False]

    def spawned() -> Spawned:
        if fails.pop(0):
            raise OSError(errno.ENOMEM, "Cannot allocate memory")
        return Spawned()

    monkeypatch.setattr(client_module, "Spawned", spawned)
    try:
        kill(solver)
        for _ in range(2):
            with pytest.raises(UserError, match=r"cannot be started \(Cannot allocate memory\); the next solve tries"):
                solver(small, **OPTIONS)
            assert not solver.is_alive
        assert solver(small, **OPTIONS).method == "neurora" and not fails
    finally:
        solver.close()
    with pytest.raises(UserError, match="the solver's process was closed"):
        solver(small, **OPTIONS)


def test_a_start_that_fails_leaves_no_descriptors(monkeypatch):
    def no_memory(*_: object, **__: object) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr(subprocess, "Popen", no_memory)
    before = os.listdir("/proc/self/fd")
    with pytest.raises(OSError, match="Cannot allocate memory"):
        Spawned()
    assert os.listdir("/proc/self/fd") == before


@pytest.mark.parametrize("work", ["a solve", "the work after it"])
def test_a_process_that_hangs_is_ended_once_nobody_waits_and_the_next_solve_starts_another(work, monkeypatch):
    monkeypatch.setattr(client_module, "_LAST_WORD_S", 0.5)
    solver, small = SolverProcess(threads=1), graph(30)
    try:
        memory, before = solver(small, **OPTIONS).memory, solver.pid
        os.kill(before, signal.SIGSTOP)
        with pytest.raises(UserError, match="has hung"), abandonable(lambda: True):
            solver(small, **OPTIONS) if work == "a solve" else solver.advance(memory, 100.0)
        assert not solver.is_alive and not Path(f"/proc/{before}").exists()
        assert solver.advance(memory, 100.0) == 0.0
        assert solver(small, memory=memory, **OPTIONS).method == "neurora" and solver.pid != before
    finally:
        solver.close()


@pytest.mark.large
def test_another_process_goes_on_from_the_labels_of_one_that_has_died():
    solver, whole = SolverProcess(threads=1), graph()
    try:
        first = solver(grown(whole, 298), **OPTIONS)
        os.kill(solver.pid, signal.SIGKILL)
        while solver.is_alive:
            time.sleep(0.01)
        start = torch.cat((first.body_from_world, first.body_from_world[-1:]))
        second = solver(grown(whole, 299), warm_start=start, memory=first.memory, **OPTIONS)
        assert set(second.stage_seconds) == {"update"}
        assert ((first.outlier_score > 0.5) != (second.outlier_score[: len(first.outlier_score)] > 0.5)).sum() <= 1
        third = solver(whole, warm_start=torch.cat((start, start[-1:])), memory=second.memory, **OPTIONS)
        assert set(third.stage_seconds) == {"update"}  # by what it remembers itself now
    finally:
        solver.close()


def test_an_answer_that_nobody_takes_any_more_ends_it_without_a_word(monkeypatch):
    """Whoever asked has gone, and the thread that listens has not heard of it yet."""
    ours, theirs = socket.socketpair()
    request = Request(1, to_arrays(graph(20)), None, None, OPTIONS)
    server = server_module.Server(Connection(theirs.detach()))
    server._requests.put(pickle.dumps(request))
    monkeypatch.setattr(server, "_listen", lambda: None)
    asking = Connection(ours.detach())
    asking.send_bytes(b"1")  # threads
    asking.close()
    server.run()


def test_an_estimator_solves_with_it(process):
    estimator = OnlineEstimator(EstimatorOptions(), process)
    for index in range(50):
        angle = 0.1 * index
        estimator.add_odometry("r", 10**9 * (index + 1), (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))
    answer = estimator.tick()
    assert answer is not None and len(answer.keyframe_id) == 50


def test_ctrl_c_is_not_for_it(process):
    for _ in range(3):
        os.kill(process.pid, signal.SIGINT)
        assert process(graph(30), **OPTIONS).method == "neurora"


# In a process of its own, which has no threads yet.
_WITH_A_COPY = """\
import os, signal, sys, time
import torch
from rotavg_ros.online.solver_process.process import Forked
copy = Forked()
from rotavg_ros.errors import UserError
from rotavg_ros.online.solver_process.client import SolverProcess
from rotavg_ros.view_graph import ViewGraph
graph = ViewGraph.create([0, 1, 0], [1, 2, 2], [[0.0, 0.0, 0.0, 1.0]] * 3, kind=[0, 0, 1])
solver = SolverProcess(1, copy)
os.kill(solver.pid, signal.SIGINT)
assert solver(graph).method == "neurora" and solver.pid == copy.pid
"""


@pytest.mark.large
def test_a_copy_that_dies_is_followed_by_another_interpreter():
    code = """\
os.kill(copy.pid, signal.SIGKILL)
try:
    solver(graph)
except UserError as error:
    print(error)
assert solver(graph).method == "neurora" and solver.pid != copy.pid
"""
    ended = subprocess.run(
        [sys.executable, "-c", _WITH_A_COPY + code], capture_output=True, text=True, check=True, timeout=120
    )
    # Whether its end is told by a solve or seen before one is a matter of microseconds.
    assert ended.stdout in (
        "",
        "the solver's process has died (exit code -9; -9 is what a lack of memory looks like); it is started again\n",
    )


@pytest.mark.large
def test_a_copy_outlives_the_terminal_where_whoever_made_it_does():
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    code = "os.kill(solver.pid, signal.SIGHUP)\nassert solver(graph).method == 'neurora' and solver.pid == copy.pid\n"
    subprocess.run([sys.executable, "-c", ignoring + _WITH_A_COPY + code], check=True, timeout=120)


def test_an_interrupt_while_the_copy_is_made_does_not_end_it():
    interrupted = """\
import os, signal
set_handler = signal.signal
def interrupted(*args):
    os.kill(os.getpid(), signal.SIGINT)
    return set_handler(*args)
os.register_at_fork(after_in_child=lambda: setattr(signal, "signal", interrupted))
"""
    subprocess.run([sys.executable, "-c", interrupted + _WITH_A_COPY], check=True, timeout=120)


def runs(pid: int) -> bool:
    """Not so once it has ended, whether or not the system's first process has taken note of it (some never do)."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in ("Z", "X")
    return False


@pytest.mark.parametrize(
    "end",
    [
        "os.kill(os.getpid(), signal.SIGKILL)",
        *(pytest.param(end, marks=pytest.mark.large) for end in ("solver.close()", "os._exit(0)", "")),
    ],
)
def test_no_copy_outlives_whoever_made_it(end: str):
    code = f"print(solver.pid, flush=True)\n{end}\n"
    ended = subprocess.run([sys.executable, "-c", _WITH_A_COPY + code], capture_output=True, text=True, timeout=120)
    (pid,) = ended.stdout.split()
    deadline = time.monotonic() + 300
    while runs(int(pid)):
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.large
def test_modules_of_the_folder_where_it_is_started_are_none_of_its(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("queue", "torch", "pickle"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('a user's own module')")
    monkeypatch.chdir(tmp_path)
    solver = SolverProcess(threads=1)
    try:
        assert solver(graph(30), **OPTIONS).method == "neurora"
    finally:
        solver.close()
