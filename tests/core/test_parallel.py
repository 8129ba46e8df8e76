"""Where fits run in parallel: spawned processes with one BLAS thread each."""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor

import pytest

from hil.core.parallel import BLAS_VARIABLES, cores, processes


def test_workers_are_spawned_processes_with_one_blas_thread_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for variable in BLAS_VARIABLES:
        monkeypatch.setenv(variable, "7")
    with processes(1) as executor:
        assert executor.submit(os.getpid).result() != os.getpid()
        assert isinstance(executor, ProcessPoolExecutor)
        assert executor._mp_context.get_start_method() == "spawn"
        threads = [executor.submit(os.getenv, name).result() for name in BLAS_VARIABLES]
    assert threads == ["1"] * len(BLAS_VARIABLES)


def test_there_is_a_worker_for_every_core_this_process_may_use() -> None:
    assert 1 <= cores() <= (os.cpu_count() or 1)
