"""The page on the mock drives' behaviour says what the code does."""

from __future__ import annotations

import re

import pytest

from hil_mock_robot.cia402 import drive
from hil_mock_robot.cia402.dictionary import MODES
from hil_mock_robot.cia402.modes import MODE_BITS
from hil_mock_robot.cia402.power import COASTING_STEPS, State, command_of, commanded
from hil_mock_robot.plant.step import OVERLOAD_S, TRACKING_LIMIT_RAD
from tests.support.paths import DOCS

PAGE = (DOCS / "reference" / "mock-can-drives.md").read_text("utf-8")


def table(heading: str) -> list[list[str]]:
    """Cells of the table whose first column is headed so, without its head."""
    block = re.search(rf"^\| {heading} .*\n\|[-|]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert block is not None
    return [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in block[1].strip().splitlines()
    ]


ROWS = {row[0]: row[1:] for row in table("from")}


@pytest.mark.parametrize("state", [state for state in State if state.value])
def test_commands_lead_where_the_page_says(state: State) -> None:
    row = ROWS[state.name.lower().replace("_", " ")]
    for word, cell in zip((0x06, 0x07, 0x0F, 0x00, 0x02, 0x80), row, strict=True):
        found = commanded(state, command_of(word, 0), stays_stopped=True)
        said = [int(number) for number in re.findall(r"\((\d+)\)", cell)]
        assert said[:1] == ([int(found[0])] if found else [])


def test_the_modes_on_the_page_are_those_that_are_built() -> None:
    said = {int(row[0]) for row in table("6060h")}
    assert said == set(MODE_BITS) == set(MODES) - {0}


def test_limits_on_the_page_are_those_of_the_code() -> None:
    codes = {row[0].split("h")[0]: row[1] for row in table("code")}
    assert f"{drive.HOT_C:g} °C" in codes["4310"]
    assert f"{drive.OVERSPEED:g} times" in codes["8400"]
    assert f"{drive.SYNC_LOST_STEPS} ms" in codes["8700"]
    assert f"{OVERLOAD_S:g} s" in codes["2310"]
    assert f"{TRACKING_LIMIT_RAD:g} rad" in codes["8611"]
    assert f"{drive.WARM_C:g} °C" in PAGE
    assert f"no current for {COASTING_STEPS} ms" in PAGE
