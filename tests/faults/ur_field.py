"""Runs one field of the wire's fault matrix and judges it by the mock controller's own journal."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tests.faults.ur_cases import NONE, SPECS, Case
from tests.faults.wire_field import (
    Field,
    Note,
    counts,
    lacking,
    lost,
    message_of,
    plan_of,
    rest_after,
    run_host,
    run_in,
    starts,
    until_struck,
)
from tests.support.mock_servers import mock_ur

CONTROLLER_STOPS = ("protective_stop", "emergency_stop", "watchdog", "power_cut")


def run_field(case: Case, folder: Path) -> Field:
    """Run a case, in folders of `folder`."""
    return until_struck(partial(_run_once, case), folder, case.stop_within_s)


def _run_once(case: Case, folder: Path) -> Field:
    spec = SPECS[case.spec]
    (folder / "faults.yaml").write_text(json.dumps([case.strikes]), "utf-8")
    arguments = ("--faults", str(folder / "faults.yaml"), *case.ending.arguments)
    with mock_ur(*arguments, journal=folder / "journal.jsonl") as mock:
        (folder / "station.yaml").write_text(_station(mock.address, arguments), "utf-8")
        exit_code = run_host(folder, spec, plan_of(spec, "ur5", "ur5"))
        ended = time.monotonic()
        mock.process.terminate()
        mock.process.wait(20)
        return _judged(case, folder, exit_code, ended, mock.journal())


def _station(address: str, arguments: Sequence[str]) -> str:
    """The driver with its own options: nothing is made easier for it."""
    model = "ur5e" if "ur5e" in arguments else "ur5"
    robot = {"driver": "ur", "model": model, "options": {"address": address}}
    return json.dumps({"hil_station": 1, "robots": {"ur5": robot}})


def _judged(
    case: Case, folder: Path, exit_code: int, ended: float, journal: Sequence[Note]
) -> Field:
    run = run_in(folder)
    fault = _fault(case, journal)
    about: dict[str, Any] = {
        "outcome": str(run.status) if run else NONE,
        "exit_code": exit_code,
        "struck": fault is not None and not _kept_from(case, exit_code, journal),
        "message": message_of(run, folder),
        "commands": starts(journal),
    }
    if fault is None:
        return Field(**about)
    about["ended_s"] = ended - fault["monotonic_s"]
    if case.ending.before:
        return Field(**about)
    if case.ending.stop_within_s is None:
        return Field(**about, lacking=lacking(run), counts=counts(run))
    after = list(journal[journal.index(fault) :])
    return Field(**about, **_stopped(case, after), lost_s=lost(run, fault["device_time"]))


def _kept_from(case: Case, exit_code: int, journal: Sequence[Note]) -> bool:
    """Whether the run did not go on as it has to, and the mock was too late for it by itself."""
    goes_on = not case.ending.before and case.ending.stop_within_s is None
    late = any(note["event"] == "slip" for note in journal)
    return goes_on and late and exit_code != case.ending.exit_code


def _fault(case: Case, journal: Sequence[Note]) -> Note | None:
    """When it struck; None where the arm was stopped before, and nothing was there to strike."""
    for note in journal:
        if note["event"] == "fault":
            return note
        if note["event"] in ("stop", *CONTROLLER_STOPS) and not case.ending.before:
            return None
    return None


def _stopped(case: Case, after: Sequence[Note]) -> dict[str, Any]:
    events = ("stop",) if case.ending.by == "driver" else CONTROLLER_STOPS
    stop = next((note for note in after if note["event"] in events), None)
    if stop is None:
        return {}
    later = after[after.index(stop) + 1 :]
    return {
        "stop_s": stop["monotonic_s"] - after[0]["monotonic_s"],
        "rest_s": rest_after(stop, after),
        "commands_after": starts(later),
    }
