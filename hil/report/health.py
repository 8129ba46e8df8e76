"""The section about the recording: continuity, tracking, temperature, drift."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import FloatArray
from hil.report.documents import as_float
from hil.report.facts import RunFacts
from hil.report.page import Block, Column, Facts, Section, Table, cells, items
from hil.report.recording import Drift, Recording
from hil.report.run_figures import RunView, figures_of
from hil.report.weighing import weighings
from hil.report.words import LATE, count, duration, joint_title, number

DEGREES = 180 / np.pi


def health(view: RunView) -> Section:
    """How good the recording is."""
    facts, recording = view.facts, view.recording
    blocks: list[Block] = [
        _continuity(facts, recording),
        *_weighings(facts),
        _ranges(recording, view.drift, view.names, facts.effort_unit),
        *figures_of("recording", view),
    ]
    return Section("recording", "Recording health", "", tuple(blocks))


def _continuity(facts: RunFacts, recording: Recording) -> Facts:
    counts = recording.counts
    # A stop document tells the wall time of its own attempt only.
    wall = as_float(None if recording.begins else facts.stop.get("wall_s"))
    measured, nominal = number(recording.measured_rate_hz, 5), number(recording.rate_hz, 5)
    missing = f"{counts.missing} samples, {number(recording.gaps_percent, 2)} %"
    said = {
        "samples": count(counts.samples),
        "recorded time": duration(recording.recorded_s),
        "attempts": len(recording.attempts) if recording.begins else None,
        "rate": f"{measured} Hz (nominal {nominal} Hz)",
        "gaps": f"{counts.gaps} ({missing})",
        "duplicates": counts.duplicates,
        "late samples": f"{counts.overruns} ({LATE})" if counts.overruns else 0,
        "dwells that did not settle": len(facts.unsettled) if facts.indices("dwell") else None,
        "wall time": duration(wall) if np.isfinite(wall) else None,
        "speed": _speed(recording.recorded_s, wall),
    }
    return Facts("Continuity", items(said))


def _weighings(facts: RunFacts) -> list[Block]:
    """What was weighed; nothing for a run without a sweep over loads."""
    told = weighings(facts)
    return [Facts("Loads as weighed", items(told))] if told else []


def _speed(device: float, wall: float) -> str | None:
    return f"{number(device / wall)} × real time" if wall > 0 else None


def _ranges(recording: Recording, drift: Drift | None, names: Sequence[str], unit: str) -> Table:
    q, qd = recording.rows["q"] * DEGREES, recording.rows["qd"] * DEGREES
    error, heat = 1e3 * recording.tracking_error(), recording.rows["temperature"]
    table: list[tuple[Column, FloatArray]] = [
        (Column("from [°]", "position"), _over_rows(np.min, q)),
        (Column("to [°]", "position"), _over_rows(np.max, q)),
        (Column("peak [°/s]", "velocity"), _over_rows(np.max, np.abs(qd))),
        (Column("RMS [mrad]", "tracking error"), np.sqrt(_over_rows(np.mean, error**2))),
        (Column("peak [mrad]", "tracking error"), _over_rows(np.max, np.abs(error))),
        (Column("start [°C]", "temperature"), heat[0]),
        (Column("end [°C]", "temperature"), heat[-1]),
    ]
    if drift is not None:
        largest = _over_rows(np.max, np.abs(drift.change))
        table.append((Column(f"largest change [{unit}]", "reference pose"), largest))
    rows = tuple(
        cells(joint_title(j, name), *(number(float(values[j])) for _, values in table))
        for j, name in enumerate(names)
    )
    columns = (Column("joint", number=False), *(column for column, _ in table))
    caption = "Ranges per joint over the whole recording"
    return Table(caption, columns, rows).without_empty_columns()


def _over_rows(what: np.ufunc | object, values: FloatArray) -> FloatArray:
    """A statistic per joint over the finite rows; NaN for a joint without any."""
    assert callable(what)
    columns = (column[np.isfinite(column)] for column in values.T)
    return np.array([float(what(column)) if len(column) else np.nan for column in columns])
