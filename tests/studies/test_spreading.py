"""Tasks of a study spread over any executor: order, dead workers, Ctrl-C, one thread each."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from functools import partial
from operator import mul
from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_info

from hil.core import parallel
from hil.core.errors import FitError, SpecError
from hil.core.parallel import BLAS_VARIABLES, one_thread, spread_over
from hil.studies.base import Ended, silent
from hil.studies.tasks import Task, run_tasks


class Watched(Executor):
    """Runs each task at once in this thread; some of its workers die."""

    def __init__(self, *, deaths: int = 0, ahead: int = 2, answers: bool = True) -> None:
        self.deaths, self.ahead, self.answers = deaths, ahead, answers
        self.threads = int(answers)
        self.most = self.open = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.open += 1
        self.most = max(self.most, self.open)
        future.add_done_callback(lambda _: setattr(self, "open", self.open - 1))
        if not self.answers:
            return future
        if self.deaths:
            self.deaths -= 1
            future.set_exception(CancelledError())
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def doubled(count: int = 5) -> list[Task]:
    return [Task(partial(mul, 2, k), cost=k) for k in range(count)]


def test_a_given_executor_takes_the_place_of_processes_and_stays_open() -> None:
    with ThreadPoolExecutor(2) as threads:
        assert run_tasks([Task(os.getpid)] * 3, 1, "asking", silent, threads) == [os.getpid()] * 3
        assert run_tasks(doubled(), 2, "doubling", silent, threads) == [0, 2, 4, 6, 8]


def test_an_executor_chosen_around_a_study_reaches_its_tasks() -> None:
    watched = Watched()
    with spread_over(watched):
        assert run_tasks(doubled(), 2, "doubling", silent) == [0, 2, 4, 6, 8]
    assert watched.most == 1
    with spread_over(None):
        run_tasks(doubled(1), 2, "doubling", silent)
    assert watched.most == 1


def test_the_longest_begin_first() -> None:
    begun: list[int] = []
    tasks = [Task(partial(begun.append, k), cost=cost) for k, cost in enumerate((1, 3, 2))]
    run_tasks(tasks, 1, "noting", silent, Watched())
    assert begun == [1, 2, 0]


class Listening:
    """A progress that is told fits that are done."""

    def __init__(self) -> None:
        self.heard: list[Ended] = []
        self.counts: list[int] = []

    def __call__(self, what: str, done: int, total: int) -> None:
        self.counts.append(done)

    def ended(self, ended: Ended) -> None:
        self.heard.append(ended)


@pytest.mark.parametrize("executor", [None, Watched()])
def test_every_task_with_a_name_is_told_once_when_it_is_done(executor: Executor | None) -> None:
    naps = [Task(partial(time.sleep, 0.02), 1.0, "short"), Task(partial(time.sleep, 0.04), 9.0, "")]
    told = Listening()
    run_tasks([*naps, Task(partial(time.sleep, 0.0), 0.1, "none")], 1, "napping", told, executor)
    names = [(one.number, one.total, one.name) for one in told.heard]
    assert names == ([(1, 3, "short"), (3, 3, "none")] if executor is None else
                     [(2, 3, "short"), (3, 3, "none")])  # fmt: skip
    assert told.heard[0].seconds >= 0.02
    assert told.counts[-1] == 3


def test_no_more_tasks_are_under_way_than_an_executor_allows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(parallel, "LOOK_S", 0.01)
    stuck = Watched(ahead=2, answers=False)
    with pytest.raises(FitError, match="no worker has been available"):
        run_tasks(doubled(), 1, "doubling", silent, stuck)
    assert stuck.most == 2


def test_a_task_whose_worker_died_is_computed_again() -> None:
    assert run_tasks(doubled(), 1, "doubling", silent, Watched(deaths=2)) == [0, 2, 4, 6, 8]


def test_a_task_that_kills_worker_after_worker_is_given_up() -> None:
    with pytest.raises(FitError, match="3 workers in succession died"):
        run_tasks(doubled(1), 1, "doubling", silent, Watched(deaths=3))


def test_an_error_of_a_task_arrives_as_it_is_and_is_not_tried_again() -> None:
    def fails(calls: list[int]) -> None:
        calls.append(1)
        raise SpecError("not like this")

    calls: list[int] = []
    with ThreadPoolExecutor(1) as threads, pytest.raises(SpecError, match="not like this"):
        run_tasks([Task(partial(fails, calls))], 1, "failing", silent, threads)
    assert len(calls) == 1


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.thorough
def test_a_process_that_dies_is_told_with_what_it_was_doing() -> None:
    with pytest.raises(FitError, match="a process died during: training") as caught:
        run_tasks([Task(die), Task(die)], 2, "training", silent)
    assert "jobs: 1" in caught.value.hint


def test_after_ctrl_c_nothing_more_begins(tmp_path: Path) -> None:
    def interrupted(what: str, done: int, total: int) -> None:
        if done:
            raise KeyboardInterrupt

    slow = [Task(partial(touch_later, str(tmp_path / f"{k}"))) for k in range(6)]
    with ThreadPoolExecutor(1) as threads, pytest.raises(KeyboardInterrupt):
        run_tasks(slow, 1, "touching", interrupted, threads)
    assert len(list(tmp_path.iterdir())) <= 3


def touch_later(path: str) -> None:
    time.sleep(0.02)
    Path(path).touch()


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info()}


def torch_threads() -> int:
    import torch

    return torch.get_num_threads()


def test_every_task_has_one_thread_of_blas(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in BLAS_VARIABLES:
        monkeypatch.setenv(name, "7")
    with one_thread():
        assert {os.environ[name] for name in BLAS_VARIABLES} == {"1"}
        assert blas_threads() == {1}
    assert {os.environ[name] for name in BLAS_VARIABLES} == {"7"}


def test_torch_here_has_one_thread_for_as_long_as_a_task_takes() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert run_tasks([Task(torch_threads)], 1, "asking", silent) == [1]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
