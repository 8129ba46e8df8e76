"""Whatever a UR controller does to a run: the arm stops in time, and the run ends in words."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil_mock_robot.ur.faults import UrFault
from tests.faults.judging import errors_of, fields, keep, require_stopped
from tests.faults.ur_cases import FAULTS, Case, steps_of
from tests.faults.ur_field import run_field

pytestmark = [pytest.mark.matrix, pytest.mark.timeout(300)]

JOURNEYS = ("protective stop", "cable out")


@pytest.mark.parametrize("case", fields(FAULTS, steps_of, Case, JOURNEYS))
def test_field_of_the_fault_matrix_over_the_wire(case: Case, tmp_path: Path) -> None:
    field = run_field(case, tmp_path)
    keep(case, field.to_dict(), "wire")
    told = f"{field.message}; {errors_of(tmp_path)}"
    ending = case.ending
    assert field.struck, f"the fault has never struck; {told}"
    assert (field.outcome, field.exit_code) == (ending.outcome, ending.exit_code), told
    if ending.before:
        assert field.commands == 0
    elif ending.stop_within_s is None:
        assert not field.lacking
        assert field.counts == ending.counts
    else:
        require_stopped(field, ending, case.stop_within_s, told)


def test_every_kind_of_fault_of_the_mock_is_in_the_matrix() -> None:
    assert {ending.fault["kind"] for ending in FAULTS.values()} == set(UrFault.kinds)
