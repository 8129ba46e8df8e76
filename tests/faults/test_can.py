"""Whatever drives and their bus do to a run: all axes stop in time, and the run ends in words."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil_mock_robot.cia402.faults import CanFault
from tests.faults.can_cases import FAULTS, Case, steps_of
from tests.faults.can_field import Field, run_field
from tests.faults.judging import errors_of, fields, keep, require_stopped

pytestmark = [pytest.mark.matrix, pytest.mark.timeout(300)]

JOURNEYS = ("following error", "drive off the bus")


@pytest.mark.parametrize("case", fields(FAULTS, steps_of, Case, JOURNEYS))
def test_field_of_the_fault_matrix_over_can(case: Case, tmp_path: Path) -> None:
    field = run_field(case, tmp_path)
    keep(case, field.to_dict(), "can")
    told = f"{field.message}; {errors_of(tmp_path)}"
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
        require_stopped(field, ending, ending.stop_within_s, told)


def _require_counted(case: Case, field: Field) -> None:
    """All that was lost is counted, and nothing else but what is in doubt because of it."""
    expected, counted = dict(case.ending.counts), dict(field.counts)
    least, missing = expected.pop("missing", 0), counted.pop("missing", 0)
    assert counted == expected
    assert least <= missing <= least + (case.ending.doubtful if least else 0)


def test_every_kind_of_fault_of_the_mock_drives_is_in_the_matrix() -> None:
    assert {ending.fault["kind"] for ending in FAULTS.values() if ending.fault} == set(
        CanFault.kinds
    )
