"""docs/reference/mock-can.md and mock-can-faults.md: complete tables, examples that run."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.testing.mocks import CanBus
from hil_mock_robot.cia402.faults import CanFault
from hil_mock_robot.cia402.mock import TELL, CanRequests, parser_of
from tests.support.paths import DOCS

REFERENCE = DOCS / "reference"
SOURCES = Path(inspect.getfile(CanRequests)).parent
FAULTS = (REFERENCE / "mock-can-faults.md").read_text("utf-8")
MOCK = (REFERENCE / "mock-can.md").read_text("utf-8")


def section(text: str, name: str) -> str:
    return text.split(f"## {name}\n")[1].split("\n## ")[0]


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.S)


def rows() -> dict[str, list[tuple[str, str]]]:
    found = re.findall(r"^\| `(\w+)` \| (.*?) \|", section(FAULTS, "Kinds"), re.M)
    return {kind: re.findall(r"`(\w+)`(?: \((.*?)\))?", keys) for kind, keys in found}


WHEN = {"at_s", "motion", "after_s"}


def test_every_kind_is_there_with_its_keys() -> None:
    told = {kind: {key for key, _ in keys} for kind, keys in rows().items()}
    assert told == {kind: set(each.keys) - WHEN for kind, each in CanFault.kinds.items()}


def test_the_defaults_are_those_of_the_code() -> None:
    for kind, keys in rows().items():
        fault = CanFault.make(kind)
        for key, default in keys:
            if default:
                told = default.replace("−", "-")
                value = int(told, 16) if told.startswith("0x") else float(told)
                assert getattr(fault, key) == value, (kind, key)


def test_the_file_is_one(tmp_path: Path) -> None:
    path = tmp_path / "faults.yaml"
    path.write_text(blocks(FAULTS, "yaml")[0], "utf-8")
    assert [fault.kind for fault in CanFault.read(path)] == [
        "bit12_low", "following_error", "emergency",
    ]  # fmt: skip


def test_every_request_of_the_side_channel_is_there() -> None:
    asked = re.findall(r'^\| `\{"do": "(\w+)"', section(FAULTS, "Side channel"), re.M)
    assert asked == list(CanRequests(SimpleNamespace(axes=()), None).answers)  # type: ignore[arg-type]


def test_every_command_of_the_shell_is_a_request() -> None:
    lines = re.findall(r"^hil mock can send (.*?)\s*(?:#.*)?$", FAULTS, re.M)
    asked = [TELL.request(line.split()[0], line.split()[1:])["do"] for line in lines]
    assert asked == ["fault", "state", "clear", "mount"]


def test_every_event_that_the_code_writes_is_in_the_table() -> None:
    told = set(re.findall(r"`(\w+)`", section(FAULTS, "Journal")))
    names = ("journal.py", "station.py")
    text = "".join((SOURCES / name).read_text("utf-8") for name in names)
    written = set(re.findall(r'(?:note|tell)\("(\w+)"', text))
    written |= set(re.findall(r'_told\(self\.number, "(\w+)"', text))
    assert written > {"start", "sync", "emergency"}
    assert written <= told


def test_every_option_is_there() -> None:
    told = set(re.findall(r"`(--[\w-]+)`", section(MOCK, "Options")))
    actions = parser_of()._actions
    options = {o for action in actions for o in action.option_strings if o.startswith("--")}
    assert told == options - {"--help"}


@pytest.mark.wire
def test_the_examples_run(can_bus: CanBus, capsys: pytest.CaptureFixture[str]) -> None:
    for example in blocks(MOCK, "python"):
        exec(compile(example, "mock-can.md", "exec"), {"CHANNEL": can_bus.channel})
    assert "SWITCH_ON_DISABLED" in capsys.readouterr().out
