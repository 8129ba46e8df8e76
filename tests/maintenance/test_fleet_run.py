"""Runs of a fleet: who is in it, workers that die or stay, and years of a simulated one."""

from __future__ import annotations

import json
import os
import shutil
import signal
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.cli.app import app
from hil.core.errors import DataError, HilError, SpecError
from hil.core.files import read_json
from hil.engine import nobody_goes_on
from hil.maintenance.fleet_run import Job, Manner, Workers, run_job
from hil.maintenance.fleet_specs import robots_like, spec_for
from hil.planning.experiment import mock_bench
from hil.planning.robots import open_robot
from hil.recording.run_group import FleetGroup, Member
from hil.robot.lease import leased
from hil.spec.load import load_station, spec_from_text
from hil.workflow.operator import OperatorChannel
from tests.support.catalogue_runs import write_run
from tests.support.fleet_parts import (
    FITTED,
    SLOW,
    SPEC,
    command,
    measurements,
    moving,
    told,
    written,
)
from tests.support.fleet_walk import walked
from tests.support.waiting import until

# A fleet's runs: who is in it, that nobody ends another's, and going on after any death


def invoke(*arguments: object) -> tuple[int, dict[str, Any]]:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    return done.exit_code, json.loads(done.stdout)


def outcomes(document: dict[str, Any]) -> dict[str, str]:
    return {one["robot"]: one.get("outcome", "none") for one in document["robots"]}


def test_robots_are_chosen_by_pattern_in_the_order_of_the_station() -> None:
    bench = mock_bench()
    assert robots_like(bench, ["ur10*", "ur3"], "lab.yaml") == ("ur10", "ur10e", "ur3")
    with pytest.raises(SpecError, match=r"^lab\.yaml has no robot 'urr5'") as caught:
        robots_like(bench, ["ur3", "urr5"], "lab.yaml")
    assert "did you mean" in caught.value.hint
    assert caught.value.hint.endswith(", ".join(bench.robots))
    many = bench.model_copy(update={"robots": {f"r{i}": bench.robots["ur5"] for i in range(99)}})
    with pytest.raises(SpecError) as caught:
        robots_like(many, ["x*"], "lab.yaml")
    assert caught.value.hint == "it has 99, the first is 'r0'"


def test_only_the_robot_of_a_spec_is_replaced() -> None:
    text = spec_for(SPEC, "small.yaml", "ur5-001")
    assert text == SPEC.replace("robot: nobody", 'robot: "ur5-001"')
    assert spec_from_text(text).robot == "ur5-001"
    with pytest.raises(SpecError, match=r"small\.yaml names no robot"):
        spec_for("hil: 1\n", "small.yaml", "ur5-001")


@pytest.mark.thorough
def test_a_broken_robot_leaves_the_others_alone_and_is_run_when_it_is_mended(
    tmp_path: Path,
) -> None:
    spec, station = written(tmp_path, {"a": "seed: 1", "b": "seed: nonsense"})
    runs = tmp_path / "runs"
    code, document = invoke(
        "fleet", "run", spec, "--station", station, "--robots", "?", "--runs", runs
    )
    assert code == document["exit_code"] == 2
    assert outcomes(document) == {"a": "completed", "b": "none"}
    assert "seed" in document["robots"][1]["error"]["message"]
    station.write_text(station.read_text("utf-8").replace("nonsense", "2"), "utf-8")
    before = measurements(runs, "a")
    code, document = invoke("fleet", "resume", document["fleet"])
    assert code == 0
    assert set(outcomes(document).values()) == {"completed"}
    assert measurements(runs, "a") == before
    (run,) = runs.glob("*/b/*")
    assert read_json(run / "start.json")["robot_name"] == "b"


def test_a_fleet_belongs_to_one_process(tmp_path: Path) -> None:
    folder = FleetGroup.create(tmp_path, "small", {"a": SPEC}, tmp_path / "small.yaml", "")
    with folder.held(), pytest.raises(DataError, match="is in use by pid"), folder.held():
        pass


def test_a_hidden_folder_is_no_run_of_a_fleet(tmp_path: Path) -> None:
    """A run that is still prepared has a start document, and so has one that is being deleted."""
    fleet = FleetGroup.create(tmp_path, "small", {"a": SPEC}, tmp_path / "small.yaml", "")
    start = {"spec": str(fleet.spec_of("a"))}
    run = write_run(tmp_path, 1, robot="a", start=start)
    for name in (".draft-0002", ".trash-0003"):
        shutil.copytree(run, run.parent / name)
    assert fleet.run_of("a") == run
    shutil.rmtree(run)
    assert fleet.run_of("a") is None


def test_a_damaged_document_is_told(tmp_path: Path) -> None:
    folder = FleetGroup.create(tmp_path, "small", {"a": SPEC}, tmp_path / "small.yaml", "")
    (folder.path / "fleet.json").write_text('{"hil_fleet_run": 1, "members": [{}]}', "utf-8")
    with pytest.raises(DataError, match="is not a list of robots"):
        FleetGroup.open(folder.path)


@pytest.mark.wire
def test_a_robot_that_somebody_else_drives_is_left_to_them(tmp_path: Path) -> None:
    spec, station = written(tmp_path, dict.fromkeys("ab", "seed: 1, clock: wall, speed: 10"))
    where = ("--station", station, "--robots", "*", "--runs", tmp_path / "runs")
    robot = open_robot("a", load_station(station).robots["a"])
    with leased(robot, name="a", driver="mock", station=str(station)):
        code, document = invoke("fleet", "run", spec, *where)
    robot.close()
    assert (code, outcomes(document)) == (4, {"a": "none", "b": "completed"})
    assert "robot a is held by pid" in document["robots"][0]["error"]["message"]


@pytest.mark.wire
def test_a_killed_worker_costs_its_own_run_alone_which_is_gone_on_with(tmp_path: Path) -> None:
    spec, station = written(tmp_path, {"a": f"seed: 1, {SLOW}", "b": f"seed: 2, {SLOW}"})
    runs = tmp_path / "runs"
    fleet = command(
        "fleet", "run", spec, "--station", station, "--robots", "*", "--runs", runs, "--workers", 2,
        "--json",
    )  # fmt: skip
    os.kill(until(lambda: moving(runs, "a")), signal.SIGKILL)
    document = told(fleet)
    assert outcomes(document) == {"a": "interrupted", "b": "completed"}
    assert "killed by SIGKILL" in document["robots"][0]["error"]["message"]
    code, again = invoke("fleet", "resume", document["fleet"])
    assert (code, outcomes(again)["a"]) == (0, "completed")
    assert again["robots"][0]["run"] == document["robots"][0]["run"]
    assert len(measurements(runs, "b")) == 1


@pytest.mark.wire
def test_ctrl_c_stops_every_arm_and_the_rest_is_done_later(tmp_path: Path) -> None:
    spec, station = written(tmp_path, dict.fromkeys("abc", f"seed: 1, {SLOW}"))
    runs = tmp_path / "runs"
    fleet = command(
        "fleet", "run", spec, "--station", station, "--robots", "*", "--runs", runs, "--workers", 2,
        "--json",
    )  # fmt: skip
    until(lambda: moving(runs, "a") or moving(runs, "b"))
    os.killpg(fleet.pid, signal.SIGINT)  # as a terminal does it
    document = told(fleet)
    assert (fleet.returncode, document["exit_code"]) == (130, 130)
    ended = outcomes(document)
    assert set(ended) == {"a", "b"}
    assert {"stopped"} <= set(ended.values()) <= {"stopped", "none"}  # the other may be starting
    assert document["left"] == ["c"]
    code, again = invoke("fleet", "resume", document["fleet"])
    assert (code, set(outcomes(again).values())) == (0, {"completed"})
    assert [len(list(runs.glob(f"*/{name}/*"))) for name in "abc"] == [1, 1, 1]


@pytest.mark.wire
def test_an_arm_stops_when_its_fleet_is_killed_and_no_run_is_made_twice(tmp_path: Path) -> None:
    spec, station = written(tmp_path, dict.fromkeys("ab", f"seed: 1, {SLOW}"))
    runs = tmp_path / "runs"
    fleet = command(
        "fleet", "run", spec, "--station", station, "--robots", "*", "--runs", runs, "--workers", 1
    )
    until(lambda: moving(runs, "a"))
    fleet.kill()
    fleet.communicate(timeout=30)
    (stop,) = until(lambda: list(runs.glob("*/a/*/stop.json")))
    assert read_json(stop)["outcome"] == "stopped"
    until(lambda: not moving(runs, "a"))
    (folder,) = runs.glob("*/fleet/*")
    assert "run" not in read_json(folder / "fleet.json")["members"][0]  # it came to nothing else
    code, again = invoke("fleet", "resume", folder)
    assert (code, set(outcomes(again).values())) == (0, {"completed"})
    assert [len(list(runs.glob(f"*/{name}/*"))) for name in "ab"] == [1, 1]


# Workers of a fleet that answer and do not go: nobody hangs on them, and signals reach them


TOLD = {"outcome": "completed"}


def stays(job: Job, answer: Connection, environment: dict[str, str]) -> None:
    """Answers, and goes by SIGTERM."""
    answer.send(TOLD)
    time.sleep(120)


def stays_whatever(job: Job, answer: Connection, environment: dict[str, str]) -> None:
    """Answers, and goes by SIGKILL alone."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    stays(job, answer, environment)


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
    monkeypatch.setattr("hil.maintenance.fleet_run.GONE_S", 400.0)
    fleet = one_at_it(tmp_path)
    ((answer, (_, process)),) = fleet.running.items()
    assert answer.poll(30.0)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    begin = time.monotonic()
    with fleet.signals():
        assert list(fleet.answers()) == [(0, TOLD)]
    assert time.monotonic() - begin < 200.0
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


# The simulated fleet from its first day to a report years later, by the how-to's commands


WORN = ("ur5-017", 1)
PROBE = SPEC.replace("fundamental_hz: 0.5, seed: 3", "fundamental_hz: 0.2, seed: 21")
PROBE = PROBE.replace("trajectories: 1", "trajectories: 4")


@pytest.mark.wire
@pytest.mark.timeout(300)  # four runs, three pools of processes
def test_two_robots_of_the_simulated_fleet_from_new_to_a_report(tmp_path: Path) -> None:
    first, probe = tmp_path / "first.yaml", tmp_path / "probe.yaml"
    first.write_text(FITTED, "utf-8")
    probe.write_text(PROBE, "utf-8")
    fits, probes, report = walked(tmp_path, ["ur5-01[67]"], first, probe)
    assert [(one["robot"], one["role"]) for one in fits] == [
        ("ur5-016", "champion"), ("ur5-017", "champion"),
    ]  # fmt: skip
    assert [one["robot"] for one in probes] == ["ur5-016", "ur5-017"]
    assert not any(one["error"] for one in probes)
    change = np.array([one["change"] for one in report["robots"]])
    assert np.unravel_index(np.argmax(change), change.shape) == (1, WORN[1])
    assert change[1, WORN[1]] > 1.2
    assert all(one["age_years"] > 1 for one in report["robots"])
    assert report["friction"] is None  # two are no fleet
