"""The pages about the PLC say what driver and mock do."""

from __future__ import annotations

import re
from dataclasses import fields

from hil_drivers.twincat.options import Options
from hil_mock_robot.twincat.faults import PlcFault
from hil_mock_robot.twincat.memory import contract, declared_in
from hil_mock_robot.twincat.program import Command, Result
from tests.support.paths import DOCS

PLC = (DOCS / "reference" / "twincat-plc.md").read_text("utf-8")
PAGE = (DOCS / "how-to" / "drive-twincat.md").read_text("utf-8")


def test_the_variables_on_the_page_are_those_of_the_mock() -> None:
    shown = re.findall(r"```iecst\n(.*?)```", PLC, re.S)[0]
    assert declared_in(shown) == contract()


def test_every_command_and_every_reason_to_refuse_one_is_on_the_page() -> None:
    for command in Command:
        assert f"| {command.value} {command.name} |" in PLC
    told = {int(number) for number in re.findall(r"\((\d+)[,)]", PLC.split("## The program")[0])}
    assert set(range(2, 18)) <= told
    assert {each.value for each in Result} == set(range(18))


def test_every_option_and_every_fault_is_on_the_page() -> None:
    for name in [field.name for field in fields(Options)] + list(PlcFault.kinds):
        assert f"`{name}`" in PAGE, name
