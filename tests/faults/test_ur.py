"""Whatever a UR controller does to a run: the arm stops in time, and the run ends in words."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_mock_robot.ur.faults import UrFault
from tests.faults.ur_cases import FAULTS, Case, steps_of
from tests.faults.ur_field import Field, run_field

LOST_AT_MOST_S = 0.25
"""Device time of samples before the fault that may be lacking."""

ENDED_WITHIN_S = 20.0
"""Wall time from the fault until the process of a run that it ends has ended: 10 s may pass until
nobody waits any more for an arm that nobody can see come to rest."""

pytestmark = [pytest.mark.matrix, pytest.mark.timeout(300)]


JOURNEYS = ("protective stop", "cable out")


def _fields() -> Iterator[Any]:
    """Every fault at one kind of step, another one each time; the rest takes longer: `proof`."""
    for number, (fault, ending) in enumerate(FAULTS.items()):
        steps = list(steps_of(ending))
        for at, step in enumerate(steps):
            once = (pytest.mark.journey,) if fault in JOURNEYS else ()
            marks = once if at == number % len(steps) else (pytest.mark.proof,)
            case = Case(step, fault)
            yield pytest.param(case, marks=marks, id=str(case))


@pytest.mark.parametrize("case", list(_fields()))
def test_field_of_the_fault_matrix_over_the_wire(case: Case, tmp_path: Path) -> None:
    field = run_field(case, tmp_path)
    _keep(case, field)
    errors = "".join(path.read_text("utf-8")[-2000:] for path in tmp_path.glob("*/stderr.txt"))
    told = f"{field.message}; {errors}"
    ending = case.ending
    assert field.struck, f"the fault has never struck; {told}"
    assert (field.outcome, field.exit_code) == (ending.outcome, ending.exit_code), told
    if ending.before:
        assert field.commands == 0
    elif ending.stop_within_s is None:
        assert not field.lacking
        assert field.counts == ending.counts
    else:
        _require_stopped(case, field, told)


def _require_stopped(case: Case, field: Field, told: str) -> None:
    assert field.stop_s is not None, "nobody stopped the arm"
    assert case.stop_within_s is not None
    assert field.stop_s <= case.stop_within_s, told
    assert field.commands_after == 0, told
    assert field.rest_s is not None, "the arm never came to rest"
    assert field.rest_s <= case.ending.rest_within_s
    assert field.lost_s is not None, "the recording cannot be read"
    assert field.lost_s <= LOST_AT_MOST_S
    assert field.ended_s is not None
    assert field.ended_s <= ENDED_WITHIN_S


def test_every_kind_of_fault_of_the_mock_is_in_the_matrix() -> None:
    assert {ending.fault["kind"] for ending in FAULTS.values()} == set(UrFault.kinds)


def _keep(case: Case, field: Field) -> None:
    """What was measured, for the table in the docs."""
    if folder := os.environ.get("HIL_MATRIX"):
        row = {"wire": True, "step": case.step, "fault": case.fault, **field.to_dict()}
        Path(folder, f"wire {case}.json").write_text(json.dumps(row), "utf-8")
