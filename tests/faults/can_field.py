"""Runs one field of the fault matrix over CAN and judges it by the mock drives' own journal."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from tests.faults.can_cases import MOVING, NONE, PATIENCE_S, Case
from tests.faults.field import REST_RAD_S
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
from tests.support.mock_servers import MockCan, mock_can

AXES = range(1, 7)
SETTLED_WITHIN_S = 5.0


def run_field(case: Case, folder: Path) -> Field:
    """Run a case, in folders of `folder`."""
    return until_struck(partial(_run_once, case), folder, case.ending.stop_within_s)


def _run_once(case: Case, folder: Path) -> Field:
    (folder / "faults.yaml").write_text(json.dumps(case.strikes), "utf-8")
    arguments = ["--faults", str(folder / "faults.yaml")]
    if case.ending.free:
        arguments += ["--sync-patience-s", str(PATIENCE_S)]
    with mock_can(*arguments, journal=folder / "journal.jsonl") as mock:
        (folder / "station.yaml").write_text(_station(case, mock), "utf-8")
        plan = plan_of(case.spec, "lab6_can", "lab6", case.cycles["rate_hz"])
        exit_code = run_host(folder, case.spec, plan, **case.done_by_host)
        ended = time.monotonic()
        _let_settle(mock)
    return _judged(case, folder, exit_code, ended, mock.journal())


def _let_settle(mock: MockCan) -> None:
    """The driver's process outlives a `hil` that was killed, and drives outlive both."""
    until = time.monotonic() + SETTLED_WITHIN_S
    while time.monotonic() < until:
        state = mock.state()
        if "OPERATION_ENABLED" not in state["states"] and state["speed_rad_s"] < REST_RAD_S:
            break
        time.sleep(0.02)


def _station(case: Case, mock: MockCan) -> str:
    options: dict[str, Any] = {
        "bus": {"interface": "hil_unix", "channel": mock.channel},
        "payload_object": 0x2100,
        **case.cycles,
    }
    robot = {"driver": "cia402", "model": "lab6", "options": options}
    return json.dumps({"hil_station": 1, "robots": {"lab6_can": robot}})


def _judged(
    case: Case, folder: Path, exit_code: int, ended: float, journal: Sequence[Note]
) -> Field:
    run = run_in(folder)
    fault = _fault(case, folder, journal)
    about: dict[str, Any] = {
        "outcome": str(run.status) if run else NONE,
        "exit_code": exit_code,
        "struck": fault is not None,
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
    after = [note for note in journal if note["monotonic_s"] >= fault["monotonic_s"]]
    clock = "device_time" if case.ending.free else "monotonic_s"
    lost_s = lost(run, fault["t"], "host_time")
    return Field(**about, **_stopped(fault, after, clock), lost_s=lost_s)


def _fault(case: Case, folder: Path, journal: Sequence[Note]) -> Note | None:
    """When it struck; None where the arm was stopped before, or did not do what it was to."""
    if case.ending.host:
        return _happened(folder, journal)
    for note in journal:
        if note["event"] == "fault":
            moves = note["speed_rad_s"] > REST_RAD_S
            return note if case.ending.before or moves == (case.step in MOVING) else None
        if note["event"] == "stop":
            return None
    return None


def _happened(folder: Path, journal: Sequence[Note]) -> Note | None:
    """The moment that the run's own process wrote down."""
    path = folder / "happened.json"
    if not path.is_file() or not journal:
        return None
    at = float(json.loads(path.read_text("utf-8"))["monotonic_s"])
    unix = at + journal[0]["t"] - journal[0]["monotonic_s"]
    return {"event": "fault", "monotonic_s": at, "t": unix}


def _stopped(fault: Note, after: Sequence[Note], clock: str) -> dict[str, Any]:
    """An arm has stopped when each of its axes has: the last one counts, on the clock named."""
    stops = [note for note in after if note["event"] == "stop"]
    off = {axis: note for note in reversed(stops) for axis in note["axes"]}
    if not off:
        return {"still_on": tuple(AXES)}
    last = max(off.values(), key=lambda note: note["monotonic_s"])
    later = after[after.index(stops[0]) + 1 :]
    again = {axis for note in later if note["event"] == "enable" for axis in note["axes"]}
    return {
        "stop_s": last[clock] - fault[clock],
        "rest_s": rest_after(stops[0], after),
        "still_on": tuple(sorted((set(AXES) - set(off)) | again)),
        "commands_after": starts(later),
    }
