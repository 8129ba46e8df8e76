"""`hil schedule`: run, plan, show, systemd."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from typer.testing import CliRunner

import hil.maintenance.reidentifying
import hil.workflow.preview
from hil.cli.app import app
from hil.core.errors import FitError, HilError, InterlockTripped
from hil.maintenance.dry_run import motions
from hil.maintenance.ledger import Ledger, Occasion, open_ledger
from hil.planning.experiment import Experiment
from hil.planning.experiment import load as load_experiment
from hil.spec.schedule import load_schedule_spec
from hil.workflow.preview import preview_experiment
from tests.support.schedule_parts import at

SCHEDULE = """
hil_schedule: 1
name: nightly
timezone: Europe/Berlin
start: 2026-01-05T03:00
probe: {{spec: probe.yaml, every: {every}}}
campaign: {{spec: campaign.yaml}}
"""
FOURIER = """
hil: 1
name: {name}
robot: ur5
excitation: {{kind: fourier, trajectories: {count}, harmonics: 2, fundamental_hz: 0.1,
  max_velocity_deg_s: 30, max_acceleration_deg_s2: 60, seed: {seed}}}
reference: {{every: 0}}
"""
FIT = "fit: [{estimator: rigid-wls}]\nvalidate: {hold_out: {trajectories: 1}}\n"


PLANNED_S = {"probe": 20.0, "campaign": 40.0}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)

    def planned(experiment: Experiment) -> tuple[None, SimpleNamespace]:
        return None, SimpleNamespace(duration_s=PLANNED_S[experiment.spec.name])

    # Planning takes seconds; that it is what `hil plan` says has a test of its own.
    monkeypatch.setattr(hil.maintenance.dry_run, "preview_experiment", planned)
    write("probe.yaml", FOURIER.format(name="probe", count=2, seed=3))
    write("campaign.yaml", FOURIER.format(name="campaign", count=2, seed=4) + FIT)
    write("nightly.yaml", SCHEDULE.format(every="1d"))
    return tmp_path


def write(name: str, text: str) -> None:
    Path(name).write_text(text)


def hil_schedule(*words: str) -> tuple[Any, str, BaseException | None]:
    """Exit code or 1, what was printed, and what was raised."""
    done = CliRunner().invoke(app, ["schedule", *words])
    return done.exit_code, done.output, done.exception


def working(monkeypatch: pytest.MonkeyPatch, error: HilError | None = None) -> list[str]:
    """In place of the pipeline: note what is due, and fail if that is said."""
    done: list[str] = []

    def work(occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        done.append(occasion.id)
        if error:
            raise error
        return {"outcome": "quiet", "text": "nothing has changed"}

    monkeypatch.setattr(hil.maintenance.reidentifying, "reidentification", lambda *a, **k: work)
    return done


def test_what_is_due_is_done_once(monkeypatch: pytest.MonkeyPatch) -> None:
    write("nightly.yaml", SCHEDULE.format(every="1min"))
    done = working(monkeypatch)
    code, told, _ = hil_schedule("run", "nightly.yaml", "--once")
    assert code == 0
    assert len(done) == 1
    assert f"{done[0]}  quiet: nothing has changed" in told
    assert [line["event"] for line in Ledger.read(Path("schedules/nightly")).lines] == [
        "started", "begun", "done",
    ]  # fmt: skip
    _, told, _ = hil_schedule("show", "nightly.yaml")
    assert told.count(done[0]) == 2
    assert "not running: hil schedule run nightly.yaml" in told
    _, told, _ = hil_schedule("show", "nightly.yaml", "--json")
    document = json.loads(told)
    assert (document["schedule"], document["run_by"], document["open"]) == ("nightly", None, None)
    assert [line["event"] for line in document["lines"]] == ["started", "begun", "done"]


def test_a_failure_ends_a_single_call_with_its_code(monkeypatch: pytest.MonkeyPatch) -> None:
    write("nightly.yaml", SCHEDULE.format(every="1min"))
    working(monkeypatch, FitError("too little data"))
    code, told, error = hil_schedule("run", "nightly.yaml", "--once")
    assert code
    assert isinstance(error, FitError)
    assert "failed" in told


def test_a_plan_says_what_would_happen_and_does_nothing(folder: Path) -> None:
    night = 'blackout: [{begin: "02:00", end: "05:00", days: [wed], why: "backup"}]\n'
    write("nightly.yaml", SCHEDULE.format(every="1d") + night)
    code, told, _ = hil_schedule("plan", "nightly.yaml", "--weeks", "2", "--json")
    assert code == 0
    document = json.loads(told)
    assert (document["probe_s"], document["campaign_s"]) == (20, 40)
    assert document["at_most_s"] == 1.1 * 80 + 3 * 60
    expected = document["expected"]
    assert len(expected) == 14
    for one in expected:
        assert one["due"][11:16] == "03:00"
        later = "blackout 02:00 to 05:00 (backup)"
        wanted = ("05:00", later) if one["why"] else ("03:00", "")
        assert (one["begins"][11:16], one["why"], one["what"]) == (*wanted, "done")
    assert sum(bool(one["why"]) for one in expected) == 2
    assert not Path("schedules").exists()
    _, told, _ = hil_schedule("plan", "nightly.yaml", "--weeks", "2")
    assert "blackout 02:00 to 05:00 (backup)" in told
    assert told.splitlines()[-1].startswith("duration of motion: probe ")


def test_a_plan_until_a_day_goes_on_to_its_end() -> None:
    today = datetime.now(ZoneInfo("Europe/Berlin")).date()
    _, told, _ = hil_schedule("plan", "nightly.yaml", "--until", f"{today}", "--json")
    assert json.loads(told)["until"][:19] == f"{today + timedelta(days=1)}T00:00:00"
    tomorrow = f"{today + timedelta(days=1)}T04:00"
    _, told, _ = hil_schedule("plan", "nightly.yaml", "--until", tomorrow, "--json")
    assert json.loads(told)["until"][:16] == tomorrow


def test_of_a_dense_plan_the_first_of_each_kind_are_shown() -> None:
    write("nightly.yaml", SCHEDULE.format(every="1min") + "missed: skip\n")
    words = ("plan", "nightly.yaml", "--weeks", "0.02")
    expected = json.loads(hil_schedule(*words, "--json")[1])["expected"]
    assert len(expected) > 200
    _, told, _ = hil_schedule(*words)
    *rows, rest, _ = told.splitlines()[1:]
    assert len(rows) == 40
    count = re.match(r"… and (\d+) more: probe, until ", rest)
    assert count is not None
    assert abs(int(count[1]) + 40 - len(expected)) <= 1  # a minute may begin in between


def test_a_plan_says_what_would_be_done_about_what_was_missed() -> None:
    with open_ledger(Path("schedules/nightly"), "nightly") as ledger:
        ledger.start("nightly", at("01 00:00"))
        due = at("02 02:00")
        ledger.add("begun", due, occasion="20261102T020000Z-probe", until=due.isoformat())
    _, told, _ = hil_schedule("plan", "nightly.yaml", "--weeks", "0.2", "--json")
    first, second, *_ = json.loads(told)["expected"]
    assert (first["what"], first["why"]) == ("missed", "begun, but not resumed within 1d")
    assert second["what"] == "missed"
    assert second["count"] > 3


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("words", "keys", "told"),
    [
        (("plan", "--until", "2020-01-01"), "", "--until 2020-01-01 is in the past"),
        (("plan", "--until", "soon"), "", "--until 'soon' is not a date"),
        (("plan",), 'blackout: [{begin: "00:01", end: "00:00"}]\n', "longer than the time between"),
        (("run",), "notify: tee\n", "notify"),
        (("run",), "missed_within: soon\n", "missed_within"),
        (("show",), "timezone: Mars/Base\n", "unknown time zone"),
        (("systemd",), "wait_for_robot: -1s\n", "wait_for_robot"),
    ],
)
def test_mistakes_are_told(words: tuple[str, ...], keys: str, told: str) -> None:
    text = SCHEDULE.format(every="1d")
    text = text.replace("timezone: Europe/Berlin\n", "") if "timezone" in keys else text
    write("nightly.yaml", text + keys)
    code, _, error = hil_schedule(words[0], "nightly.yaml", *words[1:])
    assert code
    assert isinstance(error, HilError)
    assert error.exit_code == 2
    assert told in error.message
    assert not Path("schedules").exists()


def test_the_state_of_another_schedule_is_refused() -> None:
    with open_ledger(Path("there"), "weekly") as ledger:
        ledger.start("weekly", at("01 00:00"))
    for verb in ("plan", "show"):
        _, _, error = hil_schedule(verb, "nightly.yaml", "--state", "there")
        assert "is the state folder of the schedule 'weekly'" in str(error)


def test_a_schedule_that_runs_says_so_and_is_not_run_twice() -> None:
    with open_ledger(Path("schedules/nightly"), "nightly"):
        _, told, _ = hil_schedule("show", "nightly.yaml", "--json")
        assert json.loads(told)["run_by"].startswith("pid ")
        _, _, error = hil_schedule("run", "nightly.yaml", "--once")
        assert "is run by pid" in str(error)


def test_times_are_those_of_the_schedules_zone() -> None:
    zone = ZoneInfo("Asia/Kolkata")
    write("nightly.yaml", SCHEDULE.format(every="1d").replace("Europe/Berlin", zone.key))
    with open_ledger(Path("schedules/nightly"), "nightly") as ledger:
        ledger.start("nightly", datetime.now(UTC))
        before = datetime.now(zone)
        _, told, _ = hil_schedule("show", "nightly.yaml")
    assert told.startswith("time (Asia/Kolkata)  event")
    since = re.search(r"since (\d\d:\d\d)\)", told.splitlines()[-1])
    assert since is not None
    assert since[1] in {f"{before - late:%H:%M}" for late in (timedelta(), timedelta(minutes=1))}
    assert re.search(r"next: \w+ [\d-]+ 03:00 \(Asia/Kolkata\)", told)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("cron", "mistake"),
    [
        ("0 3 31 feb *", "not due within the next eight years"),
        ("0 3 31 apr,jun *", "not due within the next eight years"),
        ("0 3 29 feb *", ""),
        ("0 3 31 * *", ""),
    ],
)
def test_a_calendar_without_such_a_day_is_refused(cron: str, mistake: str) -> None:
    text = SCHEDULE.format(every="1d").replace("every: 1d", f'cron: "{cron}"')
    write("nightly.yaml", text)
    _, _, error = hil_schedule("show", "nightly.yaml")
    if mistake:
        assert mistake in str(error)
    else:
        assert error is None


@pytest.mark.thorough
def test_a_trip_is_shown_until_it_is_released(monkeypatch: pytest.MonkeyPatch) -> None:
    write("nightly.yaml", SCHEDULE.format(every="1min") + "notify: [sh, -c, 'cat >> notices']\n")
    done = working(monkeypatch, InterlockTripped("elbow: 31 A"))
    _, told, error = hil_schedule("run", "nightly.yaml", "--once")
    assert isinstance(error, InterlockTripped)
    assert json.loads(Path("notices").read_text())["event"] == "held"
    held = "hil schedule release nightly.yaml --reason TEXT"
    assert held in told
    for words in (("run", "--once"), ("show",), ("plan", "--weeks", "0.001")):
        code, told, _ = hil_schedule(words[0], "nightly.yaml", *words[1:])
        assert (code, held in told, "elbow: 31 A" in told) == (0, True, True)
    for words in (("show",), ("plan", "--weeks", "0.001")):
        _, told, _ = hil_schedule(words[0], "nightly.yaml", "--json", *words[1:])
        assert json.loads(told)["held"]["occasion"] == done[0]
    code, told, _ = hil_schedule("release", "nightly.yaml", "--reason", "a cable")
    assert code == 0
    assert "released" in told
    assert "a cable" in told
    assert "next: " in told or "has waited" in told
    _, told, _ = hil_schedule("show", "nightly.yaml", "--json")
    assert json.loads(told)["held"] is None
    assert len(done) == 1


def test_a_person_holds_it_and_has_to_say_why() -> None:
    _, _, error = hil_schedule("hold", "nightly.yaml", "--reason", "tool change")
    assert "nightly has never been started" in str(error)
    with open_ledger(Path("schedules/nightly"), "nightly") as ledger:
        ledger.start("nightly", datetime.now(UTC) - timedelta(hours=36))
        assert hil_schedule("hold", "nightly.yaml")[0] == 2
        code, told, _ = hil_schedule("hold", "nightly.yaml", "--reason", "tool change")
        assert code == 0
        assert "tool change" in told
        _, told, _ = hil_schedule("release", "nightly.yaml", "--reason", "done")
        assert "is overdue: the process of the schedule begins it within a minute" in told


def test_what_is_next_is_not_what_is_settled() -> None:
    def shown() -> tuple[datetime, str]:
        told = [hil_schedule("show", "nightly.yaml", *json)[1] for json in (["--json"], [])]
        return datetime.fromisoformat(json.loads(told[0])["next"]), told[1]

    now = datetime.now(UTC)
    with open_ledger(Path("schedules/nightly"), "nightly") as ledger:
        ledger.start("nightly", now)
        ledger.add("unnotified", now, until=(now + timedelta(hours=20)).isoformat(), why="")
        assert shown()[0] > now + timedelta(hours=20)
        ledger.add("unnotified", now, until=(now + timedelta(days=3650)).isoformat(), why="")
        moment, told = shown()
    assert moment > now + timedelta(days=3650)
    assert "but all occasions until" in told
    assert "next: " not in told


def test_units_have_absolute_paths() -> None:
    code, told, _ = hil_schedule("systemd", "nightly.yaml", "--timer", "--user", "--json")
    assert code == 0
    files = json.loads(told)["files"]
    assert files == ["hil-nightly.service", "hil-nightly.timer"]
    here = Path.cwd()
    text = Path(files[0]).read_text()
    given = {"--state": "schedules/nightly", "--registry": "registry", "--runs": "runs"}
    for option, where in given.items():
        assert f"{option} {here / where}" in text
    assert f"run {here}/nightly.yaml " in text


@pytest.mark.thorough
def test_motions_are_those_of_the_plans(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds: list[float] = []

    def planned(experiment: Experiment) -> Any:
        plan = preview_experiment(experiment)
        seconds.append(plan[1].duration_s)
        return plan

    monkeypatch.setattr(hil.maintenance.dry_run, "preview_experiment", planned)
    took = motions(load_schedule_spec("nightly.yaml"), None, load_experiment(Path("campaign.yaml")))
    assert took.probe == timedelta()
    assert [took.campaign.total_seconds()] == [round(each) for each in seconds]
    assert seconds[0] > 20


@pytest.mark.thorough
def test_it_stays_until_a_signal_and_ends_in_order() -> None:
    command = [sys.executable, "-m", "hil", "schedule", "run", "nightly.yaml"]
    surroundings = os.environ | {"PYTHONWARNINGS": "error", "PYTHONUNBUFFERED": "1"}
    running = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=surroundings
    )
    assert running.stdout is not None
    for line in running.stdout:
        if line.startswith("next: "):
            break
    time.sleep(0.3)
    running.send_signal(signal.SIGTERM)
    _, told = running.communicate(timeout=100)
    assert running.returncode == 130
    assert "stopped between two occasions" in told
    assert "Traceback" not in told
