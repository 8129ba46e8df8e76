"""Whatever drives and their bus do to a run: all axes stop in time, and the run ends in words."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_mock_robot.cia402.faults import CanFault
from tests.faults.can_cases import FAULTS, Case, steps_of
from tests.faults.can_field import Field, run_field

LOST_AT_MOST_S = 0.25
"""Wall time of samples before the fault that may be lacking."""

ENDED_WITHIN_S = 20.0
"""Wall time from the fault until the process of a run that it ends has ended."""

pytestmark = [pytest.mark.matrix, pytest.mark.timeout(300)]


JOURNEYS = ("following error", "drive off the bus")


def _fields() -> Iterator[Any]:
    """Every fault at one kind of step, another one each time; the rest takes longer: `proof`."""
    for number, (fault, ending) in enumerate(FAULTS.items()):
        steps = steps_of(ending)
        for at, step in enumerate(steps):
            at_once = at == number % len(steps) and not ending.proof
            once = (pytest.mark.journey,) if fault in JOURNEYS else ()
            marks = once if at_once else (pytest.mark.proof,)
            case = Case(step, fault)
            yield pytest.param(case, marks=marks, id=str(case))


@pytest.mark.parametrize("case", list(_fields()))
def test_field_of_the_fault_matrix_over_can(case: Case, tmp_path: Path) -> None:
    field = run_field(case, tmp_path)
    _keep(case, field)
    told = "".join(path.read_text("utf-8")[-2000:] for path in tmp_path.glob("*/stderr.txt"))
    told += field.message
    ending = case.ending
    assert field.struck, f"the fault has never struck; {told}"
    assert (field.outcome, field.exit_code) == (ending.outcome, ending.exit_code), told
    for said in ending.says:
        assert said in field.message
    if ending.before:
        assert field.commands == 0
    elif ending.stop_within_s is None:
        assert not field.lacking
        _require_counted(case, field)
    else:
        _require_stopped(case, field, told)


def _require_counted(case: Case, field: Field) -> None:
    """All that was lost is counted, and nothing else but what is in doubt because of it."""
    expected, counted = dict(case.ending.counts), dict(field.counts)
    least, missing = expected.pop("missing", 0), counted.pop("missing", 0)
    assert counted == expected
    assert least <= missing <= least + (case.ending.doubtful if least else 0)


def _require_stopped(case: Case, field: Field, told: str) -> None:
    assert not field.still_on, f"nobody stopped these axes; {told}"
    assert field.stop_s is not None
    assert case.ending.stop_within_s is not None
    assert field.stop_s <= case.ending.stop_within_s, told
    assert field.commands_after == 0, told
    assert field.rest_s is not None, "the arm never came to rest"
    assert field.rest_s <= case.ending.rest_within_s
    assert field.lost_s is not None, "the recording cannot be read"
    assert field.lost_s <= LOST_AT_MOST_S
    assert field.ended_s is not None
    assert field.ended_s <= ENDED_WITHIN_S


def test_every_kind_of_fault_of_the_mock_drives_is_in_the_matrix() -> None:
    assert {ending.fault["kind"] for ending in FAULTS.values() if ending.fault} == set(
        CanFault.kinds
    )


def _keep(case: Case, field: Field) -> None:
    """What was measured, for the table in the docs."""
    if folder := os.environ.get("HIL_MATRIX"):
        row = {"wire": True, "step": case.step, "fault": case.fault, **field.to_dict()}
        Path(folder, f"can {case}.json").write_text(json.dumps(row), "utf-8")
