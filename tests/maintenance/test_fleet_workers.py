"""Workers of a fleet that answer and do not go: nobody hangs on them, and signals reach them."""

from __future__ import annotations

import os
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from hil.core.errors import HilError
from hil.engine import nobody_goes_on
from hil.maintenance.fleet_run import Job, Manner, Workers, run_job
from hil.recording.run_group import FleetGroup, Member
from hil.workflow.operator import OperatorChannel

TOLD = {"outcome": "completed"}


def stays(job: Job, answer: Connection) -> None:
    """Answers, and goes by SIGTERM."""
    answer.send(TOLD)
    time.sleep(120)


def stays_whatever(job: Job, answer: Connection) -> None:
    """Answers, and goes by SIGKILL alone."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    stays(job, answer)


def one_at_it(folder: Path) -> Workers:
    made = FleetGroup.create(folder, "small", {"a": "hil: 1\n"}, folder / "small.yaml", "")
    fleet = Workers(made, Manner(1))
    fleet.start(0, Member("small", "a", {}))
    return fleet


@pytest.mark.thorough
def test_a_worker_that_has_answered_and_stays_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.maintenance.fleet_run.worker_main", stays_whatever)
    monkeypatch.setattr("hil.maintenance.fleet_run.GONE_S", 0.2)
    fleet = one_at_it(tmp_path)
    ((_, process),) = fleet.running.values()
    assert list(fleet.answers()) == [(0, TOLD)]
    assert process.exitcode == -signal.SIGKILL
    assert not fleet.running


@pytest.mark.thorough
def test_ctrl_c_reaches_a_worker_that_has_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.maintenance.fleet_run.worker_main", stays)
    monkeypatch.setattr("hil.maintenance.fleet_run.GONE_S", 40.0)
    fleet = one_at_it(tmp_path)
    ((answer, (_, process)),) = fleet.running.items()
    assert answer.poll(30.0)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    begin = time.monotonic()
    with fleet.signals():
        assert list(fleet.answers()) == [(0, TOLD)]
    assert time.monotonic() - begin < 20.0
    assert process.exitcode == -signal.SIGTERM


def test_no_operator_attends_the_run_of_a_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desks: list[OperatorChannel] = []

    def resumed(run: Path, *, desk: OperatorChannel, **_: object) -> None:
        desks.append(desk)
        raise HilError("enough")

    monkeypatch.setattr("hil.maintenance.fleet_run.resume_experiment", resumed)
    (tmp_path / "start.json").write_text('{"hil_run": 1, "robot_name": "ur5"}')
    answer = run_job(Job(tmp_path, tmp_path, "", tmp_path, before=tmp_path))
    assert answer["error"]["message"] == "enough"
    assert desks[0].go_on is nobody_goes_on
