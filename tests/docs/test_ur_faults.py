"""docs/reference/mock-ur-faults.md: its tables are complete, its file is one, its example runs."""

import re
from pathlib import Path

import pytest

from hil_mock_robot.ur.dashboard import PRESSES
from hil_mock_robot.ur.faults import UrFault, UrFaults
from hil_mock_robot.ur.journal import SAFETY_FAULT, TOLD
from hil_mock_robot.ur.mock import TELL
from hil_mock_robot.ur.pacing import LockStep
from hil_mock_robot.ur.side import SideService
from tests.support.mock_servers import loopback
from tests.support.paths import DOCS
from tests.support.ur_machine import Wire, machine_of

REFERENCE = DOCS / "reference"
TEXT = (REFERENCE / "mock-ur-faults.md").read_text("utf-8")


def section(name):
    return TEXT.split(f"## {name}\n")[1].split("\n## ")[0]


def block(language):
    (found,) = re.findall(rf"```{language}\n(.*?)```", TEXT, re.S)
    return found


def rows():
    found = re.findall(r"^\| `(\w+)` \| (.*?) \|", section("Kinds"), re.M)
    return {kind: re.findall(r"`(\w+)`(?: \((.*?)\))?", keys) for kind, keys in found}


WHEN = {"at_s", "motion", "program", "after_s"}


def test_every_kind_is_there_with_its_keys():
    told = {kind: {key for key, _ in keys} for kind, keys in rows().items()}
    for kind in ("jitter", "late"):
        told[kind].add("for_s")
    assert told == {kind: set(each.keys) - WHEN for kind, each in UrFault.kinds.items()}


def test_the_defaults_are_those_of_the_code():
    for kind, keys in rows().items():
        fault = UrFault.make(kind)
        for key, default in keys:
            if default:
                value = getattr(fault, key)
                assert default.replace("−", "-") in (f"{value:g}", str(value).lower()), (kind, key)


def test_every_request_and_event_is_there():
    asked = set(re.findall(r'^\| `\{"do": "(\w+)"', section("Side channel"), re.M))
    machine = machine_of()
    session = SideService(1, machine, UrFaults(machine), LockStep()).accept(Wire())
    assert asked == set(session.requests.answers)
    journal = section("Journal")
    assert all(f"`{SAFETY_FAULT.get(event, event)}`" in journal for event in TOLD)


def test_every_button_is_there_and_every_command_of_the_shell_is_one():
    released = section("From a shell, and how stops are released")
    told = re.search(r"^The buttons: (.*?)\.", released, re.M | re.S)
    assert told
    assert re.findall(r"`(\w+)`", told[1]) == list(PRESSES)
    stops = re.findall(r"^\| `(\w+)`", released, re.M)
    assert set(stops) <= set(UrFault.kinds)
    pressed = set(re.findall(r"`pendant (\w+)`", released))
    assert pressed <= set(PRESSES)
    for line in re.findall(r"^hil mock ur send (.*?)\s*(?:#.*)?$", released, re.M):
        do, *more = line.split()
        assert TELL.request(do, more)["do"] in ("fault", "state", "pendant", "clear")


def test_the_file_is_one(tmp_path):
    path = tmp_path / "faults.yaml"
    path.write_text(block("yaml"), "utf-8")
    assert [fault.kind for fault in UrFault.read(path)] == ["silence", "protective_stop", "reboot"]


@pytest.mark.wire
def test_the_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("faults.yaml").write_text(block("yaml"), "utf-8")
    exec(compile(block("python"), "mock-ur-faults.md", "exec"), {"ADDRESS": loopback()})
