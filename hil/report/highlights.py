"""Key figures and warnings: what a reader must not miss."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.report.documents import as_float, as_objects
from hil.report.facts import RunFacts
from hil.report.fit_facts import FitFacts
from hil.report.judgement import failed_fits, nrmse_warning
from hil.report.page import KeyFigure, Mark
from hil.report.recording import Drift, Recording
from hil.report.weighing import weighing_warnings
from hil.report.words import count, duration, listed, number
from hil.robot import Status

ALARMING_PERCENT = 1.0
"""More missing samples than this are marked as a failure, fewer as a warning."""

WHOLE = 0.9995
"""A model valid on a larger share of the rows than this is called valid on all of them."""


def run_highlights(
    facts: RunFacts, recording: Recording | None, drift: Drift | None
) -> list[KeyFigure]:
    """Numbers people look for first."""
    out = fit_highlights(facts.judged_fits[0]) if facts.judged_fits else []
    if facts.steps:
        done, planned = facts.steps_done, len(facts.steps)
        mark: Mark = "" if done >= planned else "warn"
        out.append(KeyFigure("program", f"{done} of {planned}", "steps done", mark))
    if recording is not None:
        out += _of_recording(recording)
    if drift is not None:
        largest = f"{number(_peak(drift.change))} {facts.effort_unit}"
        note = f"worst joint, {len(drift.t)} visits"
        out.append(KeyFigure("drift at the reference pose", largest, note))
    return out


def fit_highlights(fit: FitFacts) -> list[KeyFigure]:
    """The held-out errors of a model."""
    note = f"{fit.label}, mean of {len(fit.joint_names)} joints"
    out = [
        KeyFigure(
            f"RMSE {signal}, held out", f"{number(fit.mean(f'rmse_{signal}'))} {fit.unit}", note
        )
        for signal in ("raw", "filtered")
    ]
    fast = fit.mean("noise_floor")
    if np.isfinite(fast):
        note = "RMS of the measured signal, mean of joints"
        out.append(KeyFigure(fit.fast_part, f"{number(fast)} {fit.unit}", note))
    return out


def run_warnings(facts: RunFacts, recording: Recording | None) -> list[str]:
    """What is wrong, or looks wrong, with a run."""
    told = facts.stop.get("problems")
    out = [*facts.problems, *(map(str, told) if isinstance(told, list) else ())]
    if facts.status == "interrupted":
        out.append("There is no stop.json: the run was interrupted.")
    if recording is None:
        out.append("No sample was recorded, or none can be read.")
    else:
        out += _continuity(facts, recording) + _status(recording)
    if poses := facts.unsettled:
        which = listed([str(pose) for pose in poses], 12)
        out.append(f"{len(poses)} dwell(s) did not settle before the time-out: poses {which}.")
    return (
        out
        + _waived(facts)
        + weighing_warnings(facts)
        + failed_fits(facts)
        + facts.studies.warnings
        + fit_warnings(facts.fits)
    )


def fit_warnings(fits: Sequence[FitFacts]) -> list[str]:
    """Models that were not judged, or not on all rows, or that have seen the target."""
    out = [f"{fit.label} has not been judged on held-out data." for fit in fits if not fit.held_out]
    named = {fit.name: fit.protocol for fit in fits if not fit.is_honest}
    out += [f"{name} is no prediction and is not judged; {why}." for name, why in named.items()]
    for fit in fits:
        out += filter(None, [nrmse_warning(fit)])
        coverage = as_float(fit.held_out.get("coverage"))
        if coverage < WHOLE:
            share = number(100 * coverage)
            out.append(
                f"{fit.label} calls itself valid on {share} % of the held-out rows; "
                "only those were judged."
            )
    return out


def _of_recording(recording: Recording) -> list[KeyFigure]:
    counts, missing = recording.counts, recording.gaps_percent
    span = f"{duration(recording.recorded_s)} at {number(recording.rate_hz)} Hz"
    mark: Mark = "fail" if missing > ALARMING_PERCENT else "warn" if missing > 0 else ""
    out = [
        KeyFigure("samples", count(counts.samples), span),
        KeyFigure("missing samples", f"{number(missing, 2)} %", f"{counts.gaps} gaps", mark),
    ]
    tracking, heat = 1e3 * _peak(recording.tracking_error()), _peak(recording.rows["temperature"])
    if np.isfinite(tracking):
        out.append(KeyFigure("largest tracking error", f"{number(tracking)} mrad"))
    if np.isfinite(heat):
        out.append(KeyFigure("hottest joint", f"{number(heat)} °C"))
    return out


def _continuity(facts: RunFacts, recording: Recording) -> tuple[str, ...]:
    out, counts = [], recording.counts
    if counts.gaps:
        share = number(recording.gaps_percent, 2)
        out.append(
            f"{counts.gaps} gap(s) in the recording: {counts.missing} samples missing ({share} %)."
        )
    if counts.duplicates:
        out.append(f"{counts.duplicates} sample(s) repeat, or go back in, device time.")
    told = facts.stop.get("samples")
    if isinstance(told, int) and told != counts.samples:
        out.append(f"stop.json counts {told} samples, the recording holds {counts.samples}.")
    return tuple(out)


def _status(recording: Recording) -> tuple[str, ...]:
    words = {
        Status.FAULT: "report a controller fault",
        Status.MASKED: "are marked as not usable",
        Status.SLOWED: "are excluded: measured slower than planned (speed slider)",
    }
    status = recording.rows["status"]
    found = {said: int(np.count_nonzero(status & bit)) for bit, said in words.items()}
    return tuple(f"{hits} sample(s) {said}." for said, hits in found.items() if hits)


def _waived(facts: RunFacts) -> list[str]:
    return [
        f"The failed preflight check {check.get('name')} was waived: {check.get('message')}"
        for check in as_objects(facts.preflight.get("checks"))
        if check.get("waived")
    ]


def _peak(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if len(finite) else float("nan")
