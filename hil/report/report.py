"""The reports: one HTML file per run, or per model that was judged outside a run.

A report is a view: a pure function of the directory it is made from, replaced whenever it is made
again, and read by nothing but people.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from hil.arms import require_same_arm
from hil.core import DataError, HilError
from hil.data import Dataset
from hil.importers import robot_of_run
from hil.recording import RunDirectory
from hil.report.background import preflight, provenance, timeline
from hil.report.excitation import excitation
from hil.report.facts import RunFacts, read_facts
from hil.report.fit_facts import FitFacts, best_first, read_fits
from hil.report.fit_sections import model_sections
from hil.report.health import health
from hil.report.highlights import fit_highlights, fit_warnings, run_highlights, run_warnings
from hil.report.judgement import (
    ENDINGS,
    badge_of,
    criteria_sentence,
    fit_sentence,
    next_command,
    sentence_of,
    verdict_badge,
)
from hil.report.measured import measured
from hil.report.page import Page, Section, write_page
from hil.report.predictions import Shown, held_out_of, show
from hil.report.recording import Drift, Recording, drift_of, read_recording
from hil.report.run_figures import RunView
from hil.report.study_sections import study_sections
from hil.report.words import listed, when

if TYPE_CHECKING:
    from hil.evaluation import Judged

REPORT_FILE = "report.html"
MOST_PLOTTED = 6
"""Models beyond this many get their tables, but no plots: the page must stay light."""


def render_report(run: Path, judged: Sequence[Judged] = ()) -> Path:
    """Write `report.html` into a run directory, whatever state the run is in.

    Args:
        run: The run directory.
        judged: Models that were judged just now: what they predicted is not computed again.

    Returns:
        The path of the page.

    Raises:
        DataError: It is not a run directory, was written by a newer hil, or its recordings were
            deleted: the page that is there shows them yet. Or its arm's description was changed.
    """
    page = Path(run) / REPORT_FILE
    if page.exists() and RunDirectory(Path(run)).pruned:
        raise DataError(
            f"{run} lacks recordings that were deleted (pruned.json)",
            hint=f"{page} was made when they were there, and stays",
        )
    return write_page(run_page(Path(run), judged), page)


def render_fit_report(
    fits: Path | Sequence[Path], held_out: Mapping[str, Dataset], out: Path
) -> Path:
    """Write a page about models that were fitted or judged outside a run.

    Args:
        fits: Model folders (`model.json`, `evaluation.json`), one or several.
        held_out: Source as `evaluation.json` names it → its samples, for the plots; models judged
            on other sources get tables only.
        out: The HTML file, replaced when it exists.

    Returns:
        The path of the page.

    Raises:
        DataError: No folder holds an evaluation.
    """
    folders = [fits] if isinstance(fits, Path) else list(fits)
    return write_page(fit_page(folders, held_out), Path(out))


def run_page(path: Path, judged: Sequence[Judged] = ()) -> Page:
    """Return the page of a run, as blocks; for the arguments see `render_report`."""
    facts = read_facts(path)
    require_same_arm(robot_of_run(facts.start), path, "leave the page that is there", gone=True)
    problems: list[str] = []
    recording = read_recording(facts, problems)
    held_out = _held_out(facts, recording, problems)
    shown = _shown(facts.judged_fits, held_out, problems, judged)
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


def fit_page(folders: Sequence[Path], held_out: Mapping[str, Dataset]) -> Page:
    """The page of models outside a run, as blocks."""
    problems: list[str] = []
    fits = best_first(read_fits(folders, problems))
    if not fits:
        names = ", ".join(str(folder) for folder in folders)
        raise DataError(
            f"there is no evaluation in {names}" + "".join(f"\n{text}" for text in problems),
            hint="judge the model first: hil evaluate MODEL SOURCE",
        )
    by_label = {fit.label: held_out[fit.source] for fit in fits if fit.source in held_out}
    shown = _shown(fits, by_label, problems)
    rows = [row for fit in fits for row in fit.criteria]
    return Page(
        title=listed(list(dict.fromkeys(fit.name for fit in fits))),
        subtitle="Models judged on recordings",
        badge=verdict_badge(all(row.get("passed") for row in rows) if rows else None),
        summary=f"{fit_sentence(fits[0])} {criteria_sentence(rows)}".strip(),
        key_figures=tuple(fit_highlights(fits[0])),
        warnings=(*problems, *fit_warnings(fits)),
        sections=tuple(model_sections(fits, shown)),
        footer=_footer(folders[0]),
    )


def _summary(facts: RunFacts) -> str:
    """What came of the run, what to do about its end, and what to type next."""
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
    drift: Drift | None,
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
    # Of a run that ended early, what happened is asked first; otherwise it is rarely looked at.
    early = facts.status in ENDINGS
    return [*(happened + sections if early else sections + happened), provenance(facts)]


def _joint_names(facts: RunFacts, recording: Recording) -> tuple[str, ...]:
    n = int(recording.rows["q"].shape[1])
    names = facts.joint_names
    return names if len(names) == n else tuple(f"joint {j + 1}" for j in range(n))


def _held_out(
    facts: RunFacts, recording: Recording | None, problems: list[str]
) -> dict[str, Dataset]:
    """Label of each model → the series of the run it was judged on."""
    out: dict[str, Dataset] = {}
    if recording is None or not facts.judged_fits:
        return out
    try:
        data = measured(facts, recording)
        for fit in facts.judged_fits:
            out[fit.label] = held_out_of(fit, data)
    except HilError as error:
        problems.append(f"Plots of the models are left out: {error.message}")
    return out


def _shown(
    fits: Sequence[FitFacts],
    held_out: Mapping[str, Dataset],
    problems: list[str],
    judged: Sequence[Judged] = (),
) -> dict[str, Shown]:
    out: dict[str, Shown] = {}
    known = {one.folder.name: one for one in judged}
    for fit in fits[:MOST_PLOTTED]:
        data = held_out.get(fit.label)
        try:
            if data is not None:
                _require_same_joints(fit, data)
                out[fit.label] = show(fit.folder, data, known.get(fit.folder.name))
        except HilError as error:
            problems.append(f"The plots of {fit.label} are left out: {error.message}")
    return out


def _require_same_joints(fit: FitFacts, data: Dataset) -> None:
    if len(fit.joint_names) != len(data.joint_names):
        raise DataError(
            f"its evaluation is of {len(fit.joint_names)} joints, the data have "
            f"{len(data.joint_names)}",
            hint="the run directory was put together from several: take it from a copy",
        )


def _footer(path: Path) -> str:
    return (
        f"Made by hil {version('hil')} from {path.resolve().name} and nothing else; "
        "it can be made again at any time."
    )
