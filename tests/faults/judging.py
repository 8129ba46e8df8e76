"""What the fields of all fault matrices are held to, and where their figures are written."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.faults.ur_cases import WireEnding
from tests.faults.wire_field import Field

LOST_AT_MOST_S = 0.25
"""Time of samples before the fault that may be lacking; wall time or device time."""

ENDED_WITHIN_S = 20.0
"""Wall time from the fault until the process of a run that it ends has ended: 10 s may pass until
nobody waits any more for an arm that nobody can see come to rest."""


def fields(
    faults: Mapping[str, Any],
    steps_of: Callable[[Any], Sequence[str]],
    case_of: Callable[[str, str], Any],
    journeys: Sequence[str],
) -> list[Any]:
    """Return every fault at one kind of step, another one each time; the rest are proofs."""

    def each() -> Iterator[Any]:
        for number, (fault, ending) in enumerate(faults.items()):
            steps = steps_of(ending)
            for at, step in enumerate(steps):
                at_once = at == number % len(steps) and not getattr(ending, "proof", False)
                once = (pytest.mark.journey,) if fault in journeys else ()
                case = case_of(step, fault)
                yield pytest.param(
                    case, marks=once if at_once else (pytest.mark.proof,), id=str(case)
                )

    return list(each())


def errors_of(folder: Path) -> str:
    """Return the last words of the processes of a field on standard error."""
    return "".join(path.read_text("utf-8")[-2000:] for path in folder.rglob("stderr.txt"))


def require_stopped(field: Field, ending: WireEnding, within_s: float | None, told: str) -> None:
    """Check that all axes stopped in time and nothing was lost, of a run that a fault ends."""
    assert not field.still_on, f"nobody stopped these axes; {told}"
    assert field.stop_s is not None, f"nobody stopped the arm; {told}"
    assert within_s is not None
    assert field.stop_s <= within_s, told
    assert field.commands_after == 0, told
    assert field.rest_s is not None, "the arm never came to rest"
    assert field.rest_s <= ending.rest_within_s
    assert field.lost_s is not None, "the recording cannot be read"
    assert field.lost_s <= LOST_AT_MOST_S
    assert field.ended_s is not None
    assert field.ended_s <= ENDED_WITHIN_S


def keep(case: Any, figures: Mapping[str, Any], matrix: str = "") -> None:
    """Write what was measured for `make fault-matrix`, which makes the tables in the docs."""
    if folder := os.environ.get("HIL_MATRIX"):
        row = {"wire": bool(matrix), "step": case.step, "fault": case.fault, **figures}
        Path(folder, f"{matrix} {case}.json".strip()).write_text(json.dumps(row), "utf-8")
