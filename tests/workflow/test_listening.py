"""Recording a robot that somebody else drives: `hil record`."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.arms.payload import Payload
from hil.cli.app import app
from hil.core.errors import DataError, PluginError, RobotConnectionError, SpecError
from hil.data.dwells import dwells_of
from hil.importers.sources import load_source
from hil.recording.mcap_reader import read_topic
from hil.recording.run_directory import RunDirectory
from hil.report import render_report
from hil.robot import Capabilities, Identity, Limits, Listens, Robot
from hil.robot.state import Status, Topic
from hil.workflow import passive_recording
from hil.workflow.passive_recording import RecordingRequest, fit_notes, record_passively
from tests.support.passive_motion import motion

BLOCK = 10
LATER_S = 3.0


class Driven:
    """A robot that repeats a program of somebody else's, faster than real time.

    Args:
        ends: Device time at which the program stops [s].
        error: Raised when all rows were read.
        slowly: Wall time per block [s].
    """

    def __init__(self, ends=4.6, error=None, slowly=0.0, begins=0.5) -> None:
        self._rows = motion([(0.0, begins), *PROGRAM, (0.5, LATER_S)])
        self._rows["effort"], self._rows["temperature"] = 0.5, 30.0
        self._rows["status"] = int(Status.HOLDING)
        self._begins, self._ends, self._error, self._slowly = begins, ends, error, slowly
        self._at = 0
        self._further: list = []
        self.said: list[str] = []
        self.capabilities = Capabilities(tuple(f"j{i}" for i in range(6)), 125.0, "current")
        self.identity = Identity("ur5", "123", "3.15", "test")
        fields = [("device_time", "<f8"), ("host_time", "<f8"), ("bits", "<u4")]
        self.topics = (Topic("/robot/extra", np.dtype(fields), 125.0, "controller"),)

    @property
    def limits(self) -> Limits:
        none = np.full(6, np.inf)
        return Limits(-none, none, none, none, none, 5.0)

    def listen(self) -> None:
        self.said.append("listen")

    @property
    def program_running(self) -> bool:
        newest = self._rows["device_time"][self._at - 1]
        return bool(self._begins < newest <= self._ends)

    def read(self, timeout_s=1.0):
        time.sleep(self._slowly)
        rows = self._rows[self._at : self._at + BLOCK].copy()
        self._at += len(rows)
        if not len(rows):
            raise self._error or AssertionError("read beyond the end")
        further = self.topics[0].blank(len(rows))
        further["device_time"], further["bits"] = rows["device_time"], 7
        self._further.append(further)
        return rows

    def drain(self):
        further, self._further = self._further, []
        return {"/robot/extra": np.concatenate(further)}

    def close(self) -> None:
        self.said.append("close")

    def connect(self) -> None:
        raise AssertionError("connect")

    prepare = start = stop = set_payload = connect


PROGRAM = [(0.5, 1.0), (0.5, 0.4), (-0.3, 1.0), (-0.3, 0.4), (0.5, 1.0), (0.5, 0.3)]


@pytest.fixture
def use(monkeypatch):
    """Let the station's robot be this one."""

    def use(robot) -> Driven:
        monkeypatch.setattr(passive_recording, "open_robot", lambda name, entry: robot)
        return robot

    return use


def recorded(tmp_path: Path, told: list[str] | None = None, **wanted):
    runs = tmp_path / "runs"
    tell = (told if told is not None else []).append
    return record_passively(RecordingRequest("ur5", **wanted), station=None, runs=runs, tell=tell)


def test_the_fake_is_what_the_protocol_says():
    assert isinstance(Driven(), Robot)
    assert isinstance(Driven(), Listens)


def test_until_the_program_stops_records_everything_and_commands_nothing(use, tmp_path):
    robot, told = use(Driven()), []
    found = recorded(tmp_path, told, until_program_stops=True)
    assert robot.said == ["listen", "close"]
    assert told[1:] == ["a program is running", "the program has stopped"]
    assert found.reason == "the program has stopped"
    assert (found.error, found.counts["missing"]) == (None, 0)
    assert 4.5 + 1.0 <= found.device_s < 4.6 + 1.2
    run = RunDirectory.open(found.run)
    rows = read_topic(run.recordings[0])
    assert len(rows) == found.counts["samples"]
    assert np.allclose(np.diff(rows["device_time"]), 0.008, atol=5e-4)
    extra = read_topic(run.recordings[0], "/robot/extra")
    assert np.array_equal(extra["device_time"][: len(rows)], rows["device_time"])
    assert run.status == "completed"
    assert run.verify() == []


def test_a_program_that_is_replaced_by_another_has_not_stopped(use, tmp_path):
    class Replaced(Driven):
        @property
        def program_running(self) -> bool:
            now = self._rows["device_time"][self._at - 1]
            return bool(super().program_running and not 2.0 < now < 2.5)

    use(Replaced())
    assert recorded(tmp_path, until_program_stops=True).device_s > 4.6


def test_for_a_time_by_the_robots_clock(use, tmp_path):
    use(Driven())
    found = recorded(tmp_path, for_s=2.0)
    assert found.reason == "the duration of 2 s has elapsed"
    assert 2.0 <= found.device_s <= 2.0 + BLOCK / 125


def test_dwells_and_moves_are_found_and_can_be_fitted_to(use, tmp_path):
    use(Driven())
    load = Payload(1.5, (0.0, 0.0, 0.05))
    found = recorded(tmp_path, until_program_stops=True, payload=load)
    assert found.steps == {"dwell": 4, "move": 3}
    assert not any("payload" in note or "missing" in note for note in found.notes)
    dwells = load_source(found.run, kinds=("dwell",))
    assert [c.pose for c in dwells.conditions] == [0, 1, 2, 1]
    assert {c.payload.mass for c in dwells.conditions} == {1.5}
    assert len(dwells) == 40
    assert np.abs(dwells["qd"]).max() < 0.005
    assert {c.kind for c in load_source(found.run).conditions} == {"dwell", "move"}
    assert dwells_of(load_source(found.run)).n_joints == 6


def test_the_report_can_be_made(use, tmp_path):
    use(Driven())
    found = recorded(tmp_path, until_program_stops=True)
    page = render_report(found.run).read_text("utf-8")
    assert "recording" in page
    assert "hil resume" not in page
    assert "is not a plan" not in page
    assert "Another program drove the robot" in page


def test_without_a_load_declared_it_says_what_is_assumed(use, tmp_path):
    use(Driven())
    assert "0 kg assumed" in recorded(tmp_path, for_s=1.0).notes[0]


def test_a_connection_that_is_lost_ends_it_with_what_there_is(use, tmp_path):
    use(Driven(error=RobotConnectionError("gone", hint="plug it in")))
    found = recorded(tmp_path)
    assert isinstance(found.error, RobotConnectionError)
    assert found.counts["samples"] == len(Driven()._rows)
    run = RunDirectory.open(found.run)
    assert (run.status, run.stop["reason"]) == ("failed", "gone")
    assert found.steps["dwell"] >= 4
    assert "hil resume" not in render_report(found.run).read_text("utf-8")


def test_ctrl_c_ends_it_in_order(use, tmp_path):
    use(Driven(slowly=0.05))
    threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
    found = recorded(tmp_path)
    assert found.error is None
    assert found.reason == "stopped by SIGINT"
    assert RunDirectory.open(found.run).status == "completed"
    assert load_source(found.run, kinds=("dwell", "move")).n_joints == 6


def test_a_recording_that_was_killed_has_its_steps_still(use, tmp_path):
    use(Driven())
    run = recorded(tmp_path, until_program_stops=True).run
    before = load_source(run)
    killed = tmp_path / "killed"
    shutil.copytree(run, killed)
    for name in ("found.json", "stop.json"):
        (killed / name).unlink()
    after = load_source(killed)
    assert [(c.kind, c.pose) for c in after.conditions] == [
        (c.kind, c.pose) for c in before.conditions
    ]


def test_it_cannot_be_resumed(use, tmp_path):
    from hil.workflow.resuming import open_unfinished

    use(Driven())
    run = recorded(tmp_path, for_s=1.0).run
    with pytest.raises(DataError, match="passive recording"):
        open_unfinished(run)


def test_a_driver_that_cannot_listen_says_so(tmp_path):
    with pytest.raises(PluginError, match="'mock' cannot record a robot that it does not drive"):
        recorded(tmp_path)
    assert not (tmp_path / "runs").exists()


def test_an_unknown_robot_says_which_there_are(tmp_path):
    with pytest.raises(SpecError, match="has no robot 'ur55'"):
        record_passively(replace(RecordingRequest("ur55")), station=None, runs=tmp_path, tell=print)


def test_the_command_prints_one_document(use, tmp_path):
    use(Driven())
    line = ["record", "--robot", "ur5", "--for", "2 s", "--runs", str(tmp_path), "--json"]
    result = CliRunner().invoke(app, [*line, "--payload", "1.2", "--name", "teach"])
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["found"] == {"dwell": 2, "move": 2}
    assert document["run"].endswith("teach")
    (note,) = document["notes"]
    assert note.startswith("2 dwells are too few for static-wls, which needs 16: record for longer")
    shown = CliRunner().invoke(app, ["show", document["run"]]).stdout
    assert f"next: hil fit {document['run']} --estimator static-wls" in " ".join(shown.split())


def test_an_arm_that_was_not_running_is_told(use, tmp_path):
    robot = use(Driven())
    robot._rows["status"][:50] |= int(Status.MASKED)
    notes = recorded(tmp_path, for_s=2.0).notes
    assert any("50 of " in note and "while the arm was not running" in note for note in notes)
    robot = use(Driven())
    assert "not running" not in " ".join(recorded(tmp_path, for_s=2.0).notes)


def test_what_a_fit_needs_is_said_only_where_it_is_lacking():
    ur5 = {"model": "ur5", "gravity_m_s2": [0.0, 0.0, -9.81]}
    assert fit_notes({"dwell": 9}, ur5)
    assert fit_notes({"dwell": 16}, ur5) == ()
    assert fit_notes({"dwell": 9, "trajectory": 1}, ur5) == ()
    assert fit_notes({}, {"model": "no arm of ours", "gravity_m_s2": [0, 0, -9.81]}) == ()


@pytest.mark.parametrize(
    ("option", "says"),
    [
        (["--for", "60"], "must be a duration"),
        (["--for", "3kg"], "must be a duration"),
        (["--until", "x"], "x"),
    ],
)
def test_the_command_refuses_what_is_no_end(option, says):
    result = CliRunner().invoke(app, ["record", "--robot", "ur5", *option])
    assert isinstance(result.exception, SpecError)
    assert says in str(result.exception)
