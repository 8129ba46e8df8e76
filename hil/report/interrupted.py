"""What a run recorded that never came to write it down: counted by its data."""

from __future__ import annotations

from hil.core import DataError
from hil.importers import completeness_of, rows_of
from hil.planning import Plan
from hil.recording import Counts, RunDirectory, attempt_of, recorded_s
from hil.report.documents import Document

_ADDED = ("samples", "gaps", "missing", "duplicates")


def recorded_by(run: RunDirectory, plan: Plan | None, rate_hz: float) -> Document:
    """The part of a stop document that the recordings tell; empty when they tell nothing.

    Args:
        run: Without stop document of its last attempt.
        plan: What was to be measured; None when nobody can say.
        rate_hz: Nominal rate of the samples [Hz].
    """
    total = dict.fromkeys(_ADDED, 0)
    attempts: dict[int, Counts] = {}
    try:
        for path in run.recordings:
            rows = rows_of(path)
            if rows is not None and len(rows):
                attempt = attempt_of(path)
                attempts[attempt] = attempts.get(attempt, Counts()).after(rows, rate_hz)
        complete = completeness_of(plan, run.recordings).to_dict() if plan else {}
    except DataError:
        return {}
    for counts in attempts.values():
        total = {name: n + getattr(counts, name) for name, n in total.items()}
    return {**total, "device_s": recorded_s(run.recordings), "complete": complete}
