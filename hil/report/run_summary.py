"""Summary of a run in sentences and numbers, for the page and the terminal.

If the run ended early, the badge shows how the run ended; otherwise, the badge shows the verdict on
the models. The summary sentence states the held-out error of the best model and the acceptance
criteria that the model does not meet. Key figures are the most important numbers of a run. Warnings
describe confirmed and possible problems of a run. Payloads are named by their mass, as operators
name them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.report.documents import Document, as_float, as_object, as_objects
from hil.report.fit_facts import FitFacts
from hil.report.page import Badge, KeyFigure, Mark
from hil.report.run_facts import RunFacts
from hil.report.run_recording import Recording, ReferenceDrift
from hil.report.words import count, criterion_text, duration, listed, number, quantity, with_unit
from hil.robot import Status

ENDINGS: dict[str, tuple[str, Mark]] = {
    "interrupted": ("INTERRUPTED", "warn"),
    "running": ("RUNNING", ""),
    "stopped": ("STOPPED", "warn"),
    "tripped": ("TRIPPED", "fail"),
    "failed": ("FAILED", "fail"),
    "damaged": ("DAMAGED", "fail"),
}


def badge_of(facts: RunFacts) -> Badge:
    """Return the badge: the status if the run ended early, otherwise the verdict on the models."""
    if facts.status in ENDINGS:
        return Badge(*ENDINGS[facts.status])
    return verdict_badge(facts.verdict.get("passed"))


VERDICTS: dict[bool | None, tuple[str, Mark]] = {
    True: ("PASSED", "pass"),
    False: ("REJECTED", "fail"),
    None: ("NOT JUDGED", ""),
}


def verdict_badge(passed: object) -> Badge:
    """Return the badge of a verdict; a value other than true and false means “not evaluated”."""
    return Badge(*VERDICTS[passed if isinstance(passed, bool) else None])


def sentence_of(facts: RunFacts) -> str:
    """Return the result of the run as plain sentences."""
    if facts.status in ENDINGS:
        parts = (_ending_sentence(facts), _progress_sentence(facts), _model_sentence(facts))
        return " ".join(filter(None, parts))
    return _model_sentence(facts) or _recording_sentence(facts)


def _ending_sentence(facts: RunFacts) -> str:
    if facts.status == "interrupted":
        return (
            "The run ended without a stop document: its process was killed, or the power failed. "
            "This page shows the data that had been written to the disk."
        )
    if facts.status == "running":
        return "The run is still active; this page shows the data written to the disk so far."
    if facts.status == "damaged":
        return "The run directory is damaged; this page shows the data that can still be read."
    words = {
        "stopped": "The run was stopped early",
        "tripped": "An interlock stopped the robot",
        "failed": "The run failed",
    }
    reason = str(facts.stop.get("reason") or "no reason was recorded").strip()
    return f"{words[facts.status]}: {reason.rstrip('.')}."


def _progress_sentence(facts: RunFacts) -> str:
    """Return the progress of the run: completed measurements, or completed steps instead."""
    if facts.measured:
        return f"Measured: {facts.measured}."
    if not facts.steps:
        return ""
    return f"{facts.steps_done} of {len(facts.steps)} steps were done."


def _model_sentence(facts: RunFacts) -> str:
    best = facts.judged_fits
    if not best:
        return ""
    rows = as_objects(facts.verdict.get("rows"))
    said = criteria_sentence(rows)
    if not best[0].is_honest:  # honest ones come first
        said = f"The model is not judged: {best[0].protocol}. {said}".strip()
    elif rows and not any(row.get("estimator") for row in rows):
        said = f"The model is not judged: the spec sets no criterion for models. {said}"
    return f"{fit_sentence(best[0])} {said or 'The spec sets no acceptance criteria.'}"


def _recording_sentence(facts: RunFacts) -> str:
    done, wanted = "The recording is complete.", facts.estimators_wanted
    if facts.commissioning:
        return (
            f"{done} This is a commissioning run ({facts.commissioning}); commissioning runs are "
            "neither fitted nor judged."
        )
    if facts.fits:
        names = listed([fit.label for fit in facts.fits])
        return f"{done} {names} was fitted, but not judged on held-out data."
    if wanted:
        return (
            f"{done} The spec requires {listed(wanted)}, but the run has no fitted model: "
            f"{'the fit failed' if failed_fits(facts) else 'no fit has been executed'}."
        )
    if facts.start.get("passive"):
        return f"{done} Another program drove the robot; no model has been fitted yet."
    said = criteria_sentence(as_objects(facts.verdict.get("rows")))
    text = f"{done} The spec requires no model, so none was fitted."
    if facts.is_dwell_program:
        text += (
            " `hil payload` identifies the mounted payload with a model of the bare arm, which "
            "`hil fit` fits."
        )
    return f"{text} {said}".strip()


def fit_sentence(fit: FitFacts) -> str:
    """Return a sentence about the held-out error of a model."""
    what = fit.held_out.get("what")
    error, fast = fit.mean("rmse_raw"), fit.mean("noise_floor")
    text = (
        f"On held-out data{f' ({what})' if what else ''} the model {fit.name} predicts the "
        f"{quantity(fit.unit)} with an error of {number(error)} {fit.unit} "
        f"(RMSE, mean of {len(fit.joint_names)} joints)"
    )
    if math.isfinite(fast):
        text += f"; the measured signal's {fit.fast_part} is {number(fast)} {fit.unit} (RMS)"
    return text + "."


def criteria_sentence(rows: Sequence[Document]) -> str:
    """Return a sentence about met and missed criteria; empty if the run has no criteria."""
    missed = [row for row in rows if not row.get("passed")]
    if not rows:
        return ""
    if not missed:
        texts = list(dict.fromkeys(criterion_text(row) for row in rows))
        return (
            f"{'The criterion is' if len(rows) == 1 else 'All criteria are'} met: {listed(texts)}."
        )
    groups = dict.fromkeys(_group(row) for row in missed)
    words = [_missed_criterion([row for row in rows if _group(row) == group]) for group in groups]
    return f"Criteria are missed: {'; '.join(words)}."


def _group(row: Document) -> tuple[str, str]:
    return str(row.get("estimator") or ""), criterion_text(row)


def _missed_criterion(rows: Sequence[Document]) -> str:
    """Return a text such as `RMSE raw ≤ 0.02 A by 2 of 6 joints, worst elbow_joint with 0.034 A`.

    The name of the model follows the text in parentheses.
    """
    missed = [row for row in rows if not row.get("passed")]
    worst = max(missed, key=lambda row: as_float(row.get("value")))
    model, criterion = _group(worst)
    found = with_unit(worst.get("value"), worst.get("unit"))
    several = f" by {len(missed)} of {len(rows)} joints, worst" if len(rows) > 1 else " by the"
    text = f"{criterion}{several} {worst.get('what')} with {found}"
    return f"{text} ({model})" if model else text


def verdict_words(facts: RunFacts) -> str:
    """Return the verdict, such as `recording passed, model not judged`; empty without a verdict."""
    if not facts.verdict:
        return ""
    said = [f"{part} {_word_of(facts.verdict, part)}" for part in ("recording", "model")]
    return ", ".join(said)


def _word_of(verdict: Document, part: str) -> str:
    """Return the verdict on one part of a run, the recording or the models, as one word.

    If an older version of hil did not store this verdict, it is derived from the verdict rows.
    """
    stored = as_object(verdict.get(part)).get("verdict")
    rows = [
        row
        for row in as_objects(verdict.get("rows"))
        if bool(row.get("estimator")) == (part == "model")
    ]
    passed = all(row.get("passed") for row in rows) if rows else None
    return str(stored or VERDICTS[passed][0].lower())


def run_highlights(
    facts: RunFacts, recording: Recording | None, drift: ReferenceDrift | None
) -> list[KeyFigure]:
    """Return the key figures of a run."""
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


ALARMING_PERCENT = 1.0
"""Share of missing samples [%] above which the key figure of the recording is marked as a
failure.

If the share of missing samples is smaller but above zero, the key figure is marked as a warning.
"""


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


def _peak(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if len(finite) else float("nan")


def fit_highlights(fit: FitFacts) -> list[KeyFigure]:
    """Return the key figures of a model: its held-out errors and the noise floor."""
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
    """Return the warnings about a run."""
    logged = facts.stop.get("problems")
    out = [*facts.problems, *(map(str, logged) if isinstance(logged, list) else ())]
    if facts.status == "interrupted":
        out.append("There is no stop.json: the run was interrupted.")
    if recording is None:
        out.append("No sample was recorded, or none can be read.")
    else:
        out += _gaps(facts, recording) + _flagged_samples(recording)
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


def _gaps(facts: RunFacts, recording: Recording) -> tuple[str, ...]:
    out, counts = [], recording.counts
    if counts.gaps:
        share = number(recording.gaps_percent, 2)
        out.append(
            f"{counts.gaps} gap(s) in the recording: {counts.missing} samples missing ({share} %)."
        )
    if counts.duplicates:
        out.append(f"{counts.duplicates} sample(s) have a repeated or decreasing device time.")
    logged = facts.stop.get("samples")
    if isinstance(logged, int) and logged != counts.samples:
        out.append(f"stop.json counts {logged} samples, the recording has {counts.samples}.")
    return tuple(out)


def _flagged_samples(recording: Recording) -> tuple[str, ...]:
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


def failed_fits(facts: RunFacts) -> list[str]:
    """Return messages about missing models of the spec, with cause and hint."""
    return [
        f"{problem.get('estimator') or 'No model'} could not be fitted and evaluated: "
        + " → ".join(filter(None, (str(problem.get(key) or "") for key in ("error", "hint"))))
        for problem in as_objects(facts.verdict.get("problems"))
    ]


WHOLE = 0.9995
"""Minimum share of rows on which a model is valid to count as valid on all rows."""


def fit_warnings(fits: Sequence[FitFacts]) -> list[str]:
    """Return warnings about the models of a run.

    The warnings concern models that were not evaluated, models that are valid on only a part of the
    rows, and models that use the target as an input.
    """
    out = [
        f"{fit.label} has not been evaluated on held-out data." for fit in fits if not fit.held_out
    ]
    named = {fit.name: fit.protocol for fit in fits if not fit.is_honest}
    out += [f"{name} is not a prediction and is not judged; {why}." for name, why in named.items()]
    for fit in fits:
        out += filter(None, [nrmse_warning(fit)])
        coverage = as_float(fit.held_out.get("coverage"))
        if coverage < WHOLE:
            share = number(100 * coverage)
            out.append(
                f"{fit.label} is valid on {share} % of the held-out rows; only these rows were "
                "evaluated."
            )
    return out


NO_SIGNAL = 0.9
"""Minimum NRMSE on the training data at which a joint counts as a joint without signal."""


def nrmse_warning(fit: FitFacts) -> str:
    """Return a warning if a limit on the mean NRMSE includes joints without signal.

    The text is empty if the limit includes no joint without signal. A joint has no signal if, even
    on the training data, the model is not more accurate than a constant. An example of a joint
    without signal is a static joint with a vertical axis, which carries no gravity load.
    """
    limited = [r for r in fit.criteria if (r.get("metric"), r.get("per")) == ("nrmse", "mean")]
    trained = zip(fit.joint_names, fit.values("nrmse", "trained"), strict=True)
    silent = [name for name, value in trained if value >= NO_SIGNAL]
    if not (limited and silent):
        return ""
    return (
        f"{fit.label}: the limit on the mean NRMSE includes {listed(silent, 6)}. For these joints, "
        "a constant is as accurate as the model even on the training data: they have no signal, "
        "and the NRMSE of any model is about 1. Limit the RMSE instead (accept.rmse)."
    )


DOUBTFUL = {
    "waived": "The payload check failed, and the failure was waived",
    "inconclusive": "The weighing cannot determine which load is mounted",
}
"""Warning text by result of a payload check, for results that are doubtful but do not end the
run.
"""


def weighing_warnings(facts: RunFacts) -> list[str]:
    """Return a warning for every payload that was measured despite a doubtful payload check."""
    newest = {e.get("load"): e for e in facts.events_of("weighing") if e.get("result") != "skipped"}
    return [
        f"{doubtful}: {load_name(facts, event.get('load'))}: {_weighing_problem(event)}."
        for event in newest.values()
        if (doubtful := DOUBTFUL.get(str(event.get("result"))))
    ]


def _weighing_problem(event: Document) -> str:
    """Return the first line of the problem of a payload check without the payload number."""
    line = str(event.get("problem") or "").partition("\n")[0]
    return line.removeprefix(f"load {event.get('load')}: ")


def weighings(facts: RunFacts) -> dict[str, str]:
    """Return the latest check result of each payload by name; empty without payload checks."""
    latest: dict[str, str] = {}
    for event in facts.events_of("weighing"):
        result = event.get("result")
        if result == "skipped":
            latest["loads"] = f"not weighed: {event.get('reason')}"
        elif result == "first":
            latest.pop(load_name(facts, 0), None)
        else:
            latest.pop("loads", None)
            latest[load_name(facts, event.get("load"))] = _weighed(event)
    return latest


def _weighed(event: Document) -> str:
    if event.get("result") != "passed":
        return _weighing_problem(event)
    declared, weighed, deviation = (
        as_float(event.get(key)) for key in ("declared_kg", "weighed_kg", "deviation_kg")
    )
    return f"{declared:.2f} kg declared, {weighed:.2f} ± {deviation:.2f} kg measured"


def load_name(facts: RunFacts, load: Any) -> str:
    """Return the name of a payload, such as `3 kg`.

    If two payloads have the same mass, the payload number is appended to the name, as in `3 kg
    (load 2)`. A payload of unknown mass is named by its payload number, as in `load 2`.
    """
    masses = [as_float(one.get("mass_kg")) for one in as_objects(facts.plan.get("loads"))]
    if not isinstance(load, int) or not 0 <= load < len(masses) or not masses[load] >= 0.0:
        return f"load {load}"
    name = f"{masses[load]:.4g} kg"
    return name if masses.count(masses[load]) == 1 else f"{name} (load {load})"
