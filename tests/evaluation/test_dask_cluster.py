"""Fits on a Dask cluster: a real scheduler with one worker process."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from functools import partial
from operator import mul
from pathlib import Path
from typing import Any

import pytest

from hil.core.errors import FitError, PluginError, SpecError
from hil.core.parallel import BLAS_VARIABLES, DaskCluster, checked_address, cluster
from hil.studies.base import silent
from hil.studies.tasks import Task, run_tasks


@pytest.fixture(scope="module")
def made() -> Iterator[Any]:
    """A cluster of one process with one thread."""
    distributed = pytest.importorskip("distributed", reason="distributed is not installed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
    ) as cluster_of_one:
        yield cluster_of_one


@pytest.fixture
def local(made: Any) -> Any:
    """The same with its worker: one that a test has killed is started again."""
    from distributed import Client

    with Client(made.scheduler_address, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)
    return made


def numbers(count: int) -> list[Task]:
    return [Task(partial(mul, 2, k), cost=k) for k in range(count)]


def once(mark: str) -> int:
    """Takes its worker along the first time."""
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return 42


def threads_asked() -> list[str | None]:
    return [os.environ.get(name) for name in BLAS_VARIABLES]


def refuse() -> None:
    raise SpecError("not like this", hint="like that")


@pytest.mark.thorough
def test_tasks_are_computed_by_the_workers_of_the_cluster(local: Any) -> None:
    with cluster(local.scheduler_address) as executor:
        told: list[tuple[str, int, int]] = []
        found = run_tasks(numbers(5), 1, "doubling", lambda *news: told.append(news), executor)
        pids = set(run_tasks([Task(os.getpid)] * 3, 1, "asking", silent, executor))
    assert found == [0, 2, 4, 6, 8]
    assert told[-1] == ("doubling", 5, 5)
    assert len(pids) == 1
    assert os.getpid() not in pids


def test_a_worker_computes_with_one_thread(local: Any) -> None:
    with cluster(local.scheduler_address) as executor:
        assert run_tasks([Task(threads_asked)], 1, "asking", silent, executor) == [["1"] * 3]


def test_an_error_of_a_task_comes_back_as_it_is(local: Any) -> None:
    with cluster(local.scheduler_address) as executor, pytest.raises(SpecError) as caught:
        run_tasks([Task(refuse)], 1, "failing", silent, executor)
    assert (caught.value.message, caught.value.hint) == ("not like this", "like that")


def test_what_a_dying_worker_computed_is_computed_again(local: Any, tmp_path: Path) -> None:
    with cluster(local.scheduler_address) as executor:
        tasks = [Task(partial(once, str(tmp_path / "mark"))), *numbers(2)]
        assert run_tasks(tasks, 1, "dying", silent, executor) == [42, 0, 2]


def test_arguments_are_sent_again_when_a_worker_dies_on_receiving_them(
    local: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    with cluster(local.scheduler_address) as executor:
        assert isinstance(executor, DaskCluster)
        scatter, broken = executor._client.scatter, [OSError("Stream is closed")]

        def breaks_once(*args: Any, **kwargs: Any) -> Any:
            if broken:
                raise broken.pop()
            return scatter(*args, **kwargs)

        monkeypatch.setattr(executor._client, "scatter", breaks_once)
        assert run_tasks(numbers(3), 1, "doubling", silent, executor) == [0, 2, 4]
        assert broken == []


def test_the_cluster_outlives_whoever_used_it(local: Any) -> None:
    for _ in range(2):
        with cluster(local.scheduler_address) as executor:
            assert run_tasks(numbers(1), 1, "doubling", silent, executor) == [0]


def test_workers_with_another_hil_are_refused(local: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.core.parallel.installed", lambda: "9.9.9")
    with pytest.raises(FitError, match=r"has hil [\d.]+, but this computer has hil 9\.9\.9"):
        DaskCluster(local.scheduler_address)


def test_without_an_address_there_is_no_cluster() -> None:
    with cluster(None) as executor:
        assert executor is None


def test_nobody_at_the_address_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="distributed is not installed")
    monkeypatch.setattr("hil.core.parallel.CONNECT_S", 0.2)
    with pytest.raises(FitError, match="no Dask scheduler answers at tcp://127") as caught:
        DaskCluster("tcp://127.0.0.1:9")
    assert "dask scheduler" in caught.value.hint


def test_a_missing_dask_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(PluginError) as caught:
        DaskCluster("tcp://127.0.0.1:8786")
    assert "hil[fleet]" in caught.value.hint


@pytest.mark.thorough
@pytest.mark.parametrize("value", ["127.0.0.1:8786", "tcp://", "tcp://host", 8786, ""])
def test_what_is_no_address_is_refused_by_name(value: object) -> None:
    with pytest.raises(SpecError, match="dask"):
        checked_address("dask", value)
