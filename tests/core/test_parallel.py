"""Where fits run in parallel: processes of a clean server, with one BLAS thread each."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

from hil.core.parallel import BLAS_VARIABLES, cores, processes
from tests.support.waiting import until


def test_workers_are_other_processes_with_one_blas_thread_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for variable in BLAS_VARIABLES:
        monkeypatch.setenv(variable, "7")
    with processes(1) as executor:
        assert executor.submit(os.getpid).result() != os.getpid()
        assert isinstance(executor, ProcessPoolExecutor)
        assert executor._mp_context.get_start_method() in ("forkserver", "spawn")  # never a fork
        threads = [executor.submit(os.getenv, name).result() for name in BLAS_VARIABLES]
    assert threads == ["1"] * len(BLAS_VARIABLES)


def test_workers_have_the_environment_and_the_folder_of_their_caller(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for number in ("1", "2"):  # the second pool finds the server of the first
        folder = tmp_path / number
        folder.mkdir()
        monkeypatch.chdir(folder)
        monkeypatch.setenv("HIL_STATION", number)
        with processes(1) as executor:
            assert executor.submit(os.getenv, "HIL_STATION").result() == number
            assert executor.submit(os.getcwd).result() == str(folder)


WAITING = """
import os, sys
from hil.core.parallel import processes

if __name__ == "__main__":
    pool = processes(1)
    print(pool.submit(os.getpid).result(), flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="Linux only")
def test_workers_end_when_their_caller_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "waiting.py"
    script.write_text(WAITING, "utf-8")
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as caller:
        assert caller.stdout is not None
        worker = int(caller.stdout.readline())
        caller.kill()
    until(lambda: not Path(f"/proc/{worker}").exists())


MASKED = """
import signal
from hil.core.parallel import process_context

def tell(answer):
    answer.send(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))

if __name__ == "__main__":
    context = process_context()
    for _ in range(2):
        ours, theirs = context.Pipe(duplex=False)
        context.Process(target=tell, args=(theirs,)).start()
        print(ours.recv())
    print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
"""


@pytest.mark.skipif(
    "forkserver" not in multiprocessing.get_all_start_methods(), reason="workers are spawned here"
)
def test_workers_begin_with_ctrl_c_blocked_and_their_caller_does_not(tmp_path: Path) -> None:
    script = tmp_path / "masked.py"
    script.write_text(MASKED, "utf-8")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True)
    assert done.stdout.split() == ["True", "True", "False"], done.stderr


def test_there_is_a_worker_for_every_core_this_process_may_use() -> None:
    assert 1 <= cores() <= (os.cpu_count() or 1)
