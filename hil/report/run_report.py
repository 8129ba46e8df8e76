"""Report of a run, or of models that were evaluated outside a run, as one HTML file.

A report depends only on the files of the run directory and is replaced whenever it is created
again. Other parts of hil do not read a report, except for the export of its figures. In the report,
models come first, then motion and recording, then sections for reference: preflight, timeline,
provenance. For a run that ended early, the timeline comes before the sections about motion and
recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.arms import require_same_arm
from hil.core import DataError, FloatArray, HilError
from hil.data import Dataset
from hil.importers import robot_of_run
from hil.recording import RunDirectory
from hil.report.documents import Document, as_float, as_index, as_object, as_objects
from hil.report.figure_list import figures_of
from hil.report.fit_facts import FitFacts, best_first, read_fits
from hil.report.model_sections import model_sections
from hil.report.next_step import next_command
from hil.report.page import (
    Block,
    Cell,
    Column,
    Facts,
    Page,
    Section,
    Table,
    cells,
    items,
    write_page,
)
from hil.report.predictions import Predictions, held_out_of, predict_with_file
from hil.report.run_facts import RunFacts, read_facts
from hil.report.run_figures import RunView
from hil.report.run_recording import Recording, ReferenceDrift, dataset_of, drift_of, read_recording
from hil.report.run_summary import (
    ENDINGS,
    badge_of,
    criteria_sentence,
    fit_highlights,
    fit_sentence,
    fit_warnings,
    load_name,
    run_highlights,
    run_warnings,
    sentence_of,
    verdict_badge,
    weighings,
)
from hil.report.study_sections import study_sections
from hil.report.words import (
    LATE,
    count,
    duration,
    in_words,
    joint_title,
    listed,
    number,
    when,
    with_unit_apart,
)

if TYPE_CHECKING:
    from hil.evaluation import Judged


REPORT_FILE = "report.html"

MOST_PLOTTED = 6
"""Maximum number of models with plots; further models have tables only, to limit the file size."""


def render_report(run: Path, judged: Sequence[Judged] = ()) -> Path:
    """Write `report.html` into a run directory; the run can have any status.

    Args:
        run: Path of the run directory.
        judged: Models that were just evaluated, whose predictions are reused.

    Returns:
        Path of the written page.

    Raises:
        DataError: The path is not a run directory, the run was written by a newer version of hil,
            its recordings were deleted, or the description of its arm was changed. If an error is
            raised, an existing page stays unchanged with its plots.
    """
    page = Path(run) / REPORT_FILE
    if page.exists() and RunDirectory(Path(run)).pruned:
        raise DataError(
            f"the recordings of {run} were deleted (pruned.json)",
            hint=f"{page} was written before their deletion and stays unchanged",
        )
    return write_page(run_page(Path(run), judged), page)


def render_fit_report(
    fits: Path | Sequence[Path], held_out: Mapping[str, Dataset], out: Path
) -> Path:
    """Write a page about models that were fitted or evaluated outside a run.

    Args:
        fits: Paths of one or more model folders (`model.json`, `evaluation.json`).
        held_out: Samples for the plots, by source name in `evaluation.json`; a model that was
            evaluated on a different source has tables only.
        out: Path of the HTML file; an existing file is replaced.

    Returns:
        Path of the written page.

    Raises:
        DataError: None of the folders contains an evaluation.
    """
    folders = [fits] if isinstance(fits, Path) else list(fits)
    return write_page(fit_page(folders, held_out), Path(out))


def run_page(path: Path, judged: Sequence[Judged] = ()) -> Page:
    """Return the page of a run; the arguments are those of `render_report`."""
    facts = read_facts(path)
    require_same_arm(robot_of_run(facts.start), path, otherwise="keep the existing page", gone=True)
    problems: list[str] = []
    recording = read_recording(facts, problems)
    held_out = _held_out(facts, recording, problems)
    shown = _predictions_of(facts.judged_fits, held_out, problems, judged)
    drift = drift_of(facts, recording) if recording else None
    about = (facts.run_name, facts.robot_title, when(facts.start.get("started")))
    return Page(
        title=facts.name,
        subtitle=" · ".join(filter(None, about)),
        badge=badge_of(facts),
        summary=_summary(facts),
        key_figures=tuple(run_highlights(facts, recording, drift)),
        warnings=(*run_warnings(facts, recording), *problems),
        sections=(
            *model_sections(facts.listed_fits, shown),
            *study_sections(facts.studies.made, [fit.name for fit in facts.listed_fits]),
            *_run_sections(facts, recording, drift, tuple(held_out.values())),
        ),
        footer=_footer(path),
    )


def _held_out(
    facts: RunFacts, recording: Recording | None, problems: list[str]
) -> dict[str, Dataset]:
    """Return the series of the run on which each model was evaluated, by model label."""
    out: dict[str, Dataset] = {}
    if recording is None or not facts.judged_fits:
        return out
    try:
        data = dataset_of(facts, recording)
    except HilError as error:
        problems.append(f"Plots of the models are omitted: {error.message}")
        return out
    for fit in facts.judged_fits:
        try:
            out[fit.label] = held_out_of(fit, data)
        except HilError as error:
            problems.append(f"The plots of {fit.label} are omitted: {error.message}")
    return out


def _predictions_of(
    fits: Sequence[FitFacts],
    held_out: Mapping[str, Dataset],
    problems: list[str],
    judged: Sequence[Judged] = (),
) -> dict[str, Predictions]:
    out: dict[str, Predictions] = {}
    known = {one.folder.name: one for one in judged}
    plotted = [fit for fit in fits if fit.label in held_out][:MOST_PLOTTED]
    for fit in plotted:
        data = held_out[fit.label]
        try:
            _require_same_joints(fit, data)
            out[fit.label] = predict_with_file(fit.folder, data, known.get(fit.folder.name))
        except HilError as error:
            problems.append(f"The plots of {fit.label} are omitted: {error.message}")
    return out


def _require_same_joints(fit: FitFacts, data: Dataset) -> None:
    if len(fit.joint_names) != len(data.joint_names):
        raise DataError(
            f"its evaluation has {len(fit.joint_names)} joints, the data have "
            f"{len(data.joint_names)}",
            hint="the run directory contains files of another run: restore it from a backup",
        )


def _summary(facts: RunFacts) -> str:
    """Return the result of the run, the hint after an early end, and the next command."""
    hint = str(facts.stop.get("hint") or "")
    return " ".join(
        filter(
            None,
            (
                sentence_of(facts),
                f"To do: {hint.rstrip('.')}." if hint else "",
                f"Next: {command}" if (command := next_command(facts, facts.run_name)) else "",
            ),
        )
    )


def _run_sections(
    facts: RunFacts,
    recording: Recording | None,
    drift: ReferenceDrift | None,
    held_out: Sequence[Dataset],
) -> list[Section]:
    sections: list[Section] = []
    if recording is not None:
        names = _joint_names(facts, recording)
        view = RunView(facts, recording, drift, names, held_out)
        sections += [excitation(view), health(view)]
    happened = [timeline(facts)]
    if checks := preflight(facts):
        happened.insert(0, checks)
    # For a run that ended early, the timeline comes first.
    early = facts.status in ENDINGS
    return [*(happened + sections if early else sections + happened), provenance(facts)]


def _joint_names(facts: RunFacts, recording: Recording) -> tuple[str, ...]:
    n = int(recording.rows["q"].shape[1])
    names = facts.joint_names
    return names if len(names) == n else tuple(f"joint {j + 1}" for j in range(n))


def _footer(path: Path) -> str:
    return (
        f"Generated by hil {version('hil')} from {path.resolve().name} only; it can be generated "
        "again at any time."
    )


def excitation(view: RunView) -> Section:
    """Return the section about the recorded motion."""
    blocks: list[Block] = [_plan(view.facts), *figures_of("excitation", view)]
    lead = "Motion of the arm, from the recorded positions."
    return Section("excitation", "Excitation", lead, tuple(blocks))


def _plan(facts: RunFacts) -> Facts:
    kinds = [str(step.get("kind")) for step in facts.steps]
    poses = {as_index(step.get("pose")) for step in facts.steps if step.get("kind") == "dwell"}
    rows: dict[str, object] = {
        "steps": f"{facts.steps_done} of {len(kinds)} done" if kinds else None,
        "poses": len(poses) or None,
        "dwells": kinds.count("dwell") or None,
        "trajectories": kinds.count("trajectory") or None,
        "reference visits": kinds.count("reference") or None,
    }
    condition = as_float(facts.plan.get("condition_number"))
    if np.isfinite(condition):
        rows["condition number of the regressor"] = number(condition)
    for name, value in as_object(facts.plan.get("margins")).items():
        rows[f"margin: {with_unit_apart(name)}"] = number(as_float(value))
    return Facts("Plan", items(rows))


DEGREES = 180 / np.pi


def health(view: RunView) -> Section:
    """Return the section about the quality of the recording."""
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
    # A stop document contains the wall time of its own attempt only.
    wall = as_float(None if recording.attempt_starts else facts.stop.get("wall_s"))
    measured, nominal = number(recording.measured_rate_hz, 5), number(recording.rate_hz, 5)
    missing = f"{counts.missing} samples, {number(recording.gaps_percent, 2)} %"
    rows = {
        "samples": count(counts.samples),
        "recorded time": duration(recording.recorded_s),
        "attempts": len(recording.attempts) if recording.attempt_starts else None,
        "rate": f"{measured} Hz (nominal {nominal} Hz)",
        "gaps": f"{counts.gaps} ({missing})",
        "duplicates": counts.duplicates,
        "late samples": f"{counts.overruns} ({LATE})" if counts.overruns else 0,
        "dwells that did not settle": len(facts.unsettled) if facts.indices("dwell") else None,
        "wall time": duration(wall) if np.isfinite(wall) else None,
        "speed": _speed(recording.recorded_s, wall),
    }
    return Facts("Continuity", items(rows))


def _speed(device: float, wall: float) -> str | None:
    return f"{number(device / wall)} × real time" if wall > 0 else None


def _weighings(facts: RunFacts) -> list[Block]:
    """Return the payload-check results as a block of the page; empty without payload checks."""
    rows = weighings(facts)
    return [Facts("Weighed loads", items(rows))] if rows else []


def _ranges(
    recording: Recording, drift: ReferenceDrift | None, names: Sequence[str], unit: str
) -> Table:
    q, qd = recording.rows["q"] * DEGREES, recording.rows["qd"] * DEGREES
    error, temperature = 1e3 * recording.tracking_error(), recording.rows["temperature"]
    table: list[tuple[Column, FloatArray]] = [
        (Column("from [°]", "position"), _over_rows(np.min, q)),
        (Column("to [°]", "position"), _over_rows(np.max, q)),
        (Column("peak [°/s]", "velocity"), _over_rows(np.max, np.abs(qd))),
        (Column("RMS [mrad]", "tracking error"), np.sqrt(_over_rows(np.mean, error**2))),
        (Column("peak [mrad]", "tracking error"), _over_rows(np.max, np.abs(error))),
        (Column("start [°C]", "temperature"), temperature[0]),
        (Column("end [°C]", "temperature"), temperature[-1]),
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


def _over_rows(statistic: Callable[[FloatArray], float], values: FloatArray) -> FloatArray:
    """Return a statistic of each joint over its finite rows; NaN without finite rows."""
    columns = (column[np.isfinite(column)] for column in values.T)
    return np.array([float(statistic(column)) if len(column) else np.nan for column in columns])


MOST_EVENTS = 200

ROUTINE = ("dwell", "checkpoint")
"""Kinds of frequent events that the timeline counts instead of listing."""

NOT_IN_DETAILS = ("t", "time", "kind")


def timeline(facts: RunFacts) -> Section:
    """Return the section with the logged events, except routine events."""
    shown = [event for event in facts.events if event.get("kind") not in ROUTINE]
    begin = as_float(facts.events[0].get("t")) if facts.events else float("nan")
    columns = tuple(Column(title, number=False) for title in ("after", "event", "details"))
    rows = tuple(_event(facts, event, begin) for event in shown[:MOST_EVENTS])
    counts = {kind: len(facts.events_of(kind)) for kind in ROUTINE}
    left_out = ", ".join(f"{times} × {kind}" for kind, times in counts.items() if times)
    note = f"Not listed: {left_out}. Times are wall time." if left_out else "Times are wall time."
    if len(shown) > MOST_EVENTS:
        note += f" Only the first {MOST_EVENTS} of {len(shown)} events are shown."
    table = Table("Events of the run", columns, rows, note)
    lead = "" if rows else "No events were logged."
    return Section("timeline", "Timeline", lead, (table,) if rows else ())


def _event(facts: RunFacts, event: Document, begin: float) -> tuple[Cell, ...]:
    after = duration(as_float(event.get("t")) - begin)
    entries = dict(event)
    if isinstance(entries.get("load"), int):
        entries["load"] = load_name(facts, entries["load"])
    details = ", ".join(
        f"{k}: {in_words(v)}" for k, v in entries.items() if k not in NOT_IN_DETAILS
    )
    kind = str(event.get("kind"))
    return Cell(after), Cell(kind, "fail" if kind == "trip" else ""), Cell(details or "–")


def preflight(facts: RunFacts) -> Section | None:
    """Return the section with the preflight checks; None if no check results are stored."""
    checks = as_objects(facts.preflight.get("checks"))
    if not checks:
        return None
    columns = tuple(Column(title, number=False) for title in ("check", "result", "details"))
    table = Table("Checks before motion", columns, tuple(_check(check) for check in checks))
    passed = all(check.get("passed") for check in checks)
    return Section("preflight", "Preflight", "", (table,), folded=passed)


def _check(check: Document) -> tuple[Cell, ...]:
    result = Cell("passed", "pass") if check.get("passed") else Cell("failed", "fail")
    if check.get("waived"):
        result = Cell("failed, waived", "warn")
    return Cell(str(check.get("name"))), result, Cell(str(check.get("message") or "–"))


def provenance(facts: RunFacts) -> Section:
    """Return the section about the origin of the data: run, code, robot, payloads, packages."""
    packages = Facts("Packages", items(as_object(facts.start.get("packages"))))
    blocks: list[Block] = [
        Facts("Run", items(_run(facts))),
        Facts("Code and plan", items(_code(facts))),
        Facts("Robot", items(_robot(facts))),
    ]
    if loads := as_objects(facts.plan.get("loads")):
        blocks.append(_loads(loads))
    return Section("provenance", "Provenance", "", (*blocks, packages), folded=True)


def _run(facts: RunFacts) -> Mapping[str, Any]:
    start = facts.start
    names = ("uid", "experiment", "started", "operator", "host", "station", "seed")
    waivers = start.get("waivers")
    return {
        **{name: start.get(name) for name in names},
        "stopped": facts.stop.get("stopped"),
        "commissioning": as_object(start.get("commissioning")).get("text"),
        "waivers": ", ".join(map(_waiver, waivers)) if isinstance(waivers, list) else waivers,
    }


def _waiver(waiver: Any) -> str:
    """Return the waived check, the reason for the waiver, and the person who waived the check."""
    if not isinstance(waiver, dict):
        return str(waiver)
    return f"{waiver.get('check')} ({waiver.get('reason')}; {waiver.get('who')})"


def _code(facts: RunFacts) -> Mapping[str, Any]:
    start, git = facts.start, as_object(facts.start.get("git"))
    dirty = git.get("dirty")
    return {
        "spec hash": start.get("spec_hash"),
        "plan hash": start.get("plan_hash"),
        "git commit": git.get("sha"),
        "uncommitted changes": ("yes" if dirty else "no") if isinstance(dirty, bool) else None,
        "python": start.get("python"),
        "platform": start.get("platform"),
    }


def _robot(facts: RunFacts) -> Mapping[str, Any]:
    robot, identity = facts.robot, as_object(facts.robot.get("identity"))
    gains = robot.get("drive_gains")
    return {
        "model": robot.get("model"),
        **{name: identity.get(name) for name in ("serial", "firmware", "driver")},
        **as_object(identity.get("details")),
        "measures": robot.get("effort_kind"),
        "drive gains [N·m/A]": ", ".join(map(str, gains)) if isinstance(gains, list) else None,
        "drive gains from": robot.get("drive_gains_source"),
        "clock": robot.get("clock"),
    }


def _loads(loads: Any) -> Table:
    columns = (
        Column("number in the spec", number=False),
        Column("mass [kg]"),
        Column("centre of mass [m]"),
        Column("prompt to the operator", number=False),
    )
    rows = tuple(
        cells(
            str(i),
            number(as_float(load.get("mass_kg"))),
            _vector(load.get("com_m")),
            str(load.get("prompt") or "–"),
        )
        for i, load in enumerate(loads)
    )
    return Table("Declared payloads", columns, rows)


def _vector(value: Any) -> str:
    given = value if isinstance(value, list) else ()
    return ", ".join(f"{as_float(item):g}" for item in given) or "–"


def fit_page(folders: Sequence[Path], held_out: Mapping[str, Dataset]) -> Page:
    """Return the page of models that were evaluated outside a run."""
    problems: list[str] = []
    fits = best_first(read_fits(folders, problems))
    if not fits:
        names = ", ".join(str(folder) for folder in folders)
        raise DataError(
            f"there is no evaluation in {names}" + "".join(f"\n{text}" for text in problems),
            hint="evaluate the model first: hil evaluate MODEL SOURCE",
        )
    by_label = {fit.label: held_out[fit.source] for fit in fits if fit.source in held_out}
    shown = _predictions_of(fits, by_label, problems)
    rows = [row for fit in fits for row in fit.criteria]
    return Page(
        title=listed(list(dict.fromkeys(fit.name for fit in fits))),
        subtitle="Models evaluated on recordings",
        badge=verdict_badge(all(row.get("passed") for row in rows) if rows else None),
        summary=f"{fit_sentence(fits[0])} {criteria_sentence(rows)}".strip(),
        key_figures=tuple(fit_highlights(fits[0])),
        warnings=(*problems, *fit_warnings(fits)),
        sections=tuple(model_sections(fits, shown)),
        footer=_footer(folders[0]),
    )
