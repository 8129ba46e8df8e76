"""Whatever goes wrong at whatever step: the arm stops in time, and the run ends in words."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.cases import FAULTS, SPEED, Case, at_once, cases
from tests.faults.field import run_field
from tests.faults.judging import LOST_AT_MOST_S, errors_of, keep

pytestmark = pytest.mark.matrix

JOURNEYS = ("kill -9", "robot fault", "disk full")


def _marks(case: Case) -> tuple[pytest.MarkDecorator, ...]:
    if not at_once(case):
        return (pytest.mark.proof,)
    return (pytest.mark.journey,) if case.fault in JOURNEYS else ()


FIELDS = [pytest.param(case, marks=_marks(case), id=str(case)) for case in cases()]


@pytest.mark.parametrize("case", FIELDS)
def test_field_of_the_fault_matrix(case: Case, tmp_path: Path) -> None:
    field = run_field(case, tmp_path)
    keep(case, field.to_dict())
    told = errors_of(tmp_path)
    ending = case.ending
    assert (field.outcome, field.exit_code) == (ending.outcome, ending.exit_code), told
    if ending.stop_within_s is None:
        assert not field.lacking
        return
    assert field.stop_s is not None
    assert field.stop_s <= ending.stop_within_s, told
    assert field.commands_after == 0, told
    assert field.rest_s is not None, "the arm never came to rest"
    assert field.rest_s <= ending.rest_within_s
    assert field.lost_s is not None, "the recording cannot be read"
    if case.fault == "kill -9":
        assert field.lost_s / SPEED <= LOST_AT_MOST_S


def test_every_fault_of_the_matrix_can_be_made() -> None:
    from tests.faults.can_cases import FAULTS as OVER_CAN
    from tests.faults.host import FAULTS as MADE

    here = {name for name, ending in FAULTS.items() if not ending.mock} - {"raising observer"}
    assert here | {ending.host for ending in OVER_CAN.values()} - {""} == set(MADE)
