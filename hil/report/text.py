"""Summary of a run for a terminal: plain lines of at most 80 columns, with unbroken paths."""

from __future__ import annotations

from pathlib import Path
from textwrap import wrap

import numpy as np

from hil.estimators import models_below
from hil.report.documents import as_float
from hil.report.fit_facts import FitFacts
from hil.report.next_step import RESUMABLE, next_command
from hil.report.run_facts import RunFacts, read_facts
from hil.report.run_summary import (
    badge_of,
    failed_fits,
    nrmse_warning,
    sentence_of,
    verdict_words,
    weighing_warnings,
    weighings,
)
from hil.report.words import LATE, counted, criterion_text, duration, joint_title, number, when

WIDTH = 80
LABEL = 11
NAMES = 28
COLUMN, NARROW = 11, 9
APART = 2


def summary_lines(run: Path, width: int = WIDTH) -> list[str]:
    """Return the summary lines of a run: description, end of the run, and model errors.

    The samples of the run are not read.

    Args:
        run: Path of the run directory.
        width: Width of the terminal in columns; the table of a model requires 40 columns.

    Raises:
        DataError: The path is not a run directory, or the run was written by a newer version of
            hil.
    """
    facts = read_facts(Path(run))
    lines = [*wrap(f"{badge_of(facts).text}  {facts.name}", width), ""]
    lines += [*_paragraph(sentence_of(facts), width), ""]
    for label, value in _details(facts):
        lines += _labelled(label, value, width)
    for fit in facts.judged_fits:
        lines += ["", *_fit_lines(fit, width)]
    for study in facts.studies.made:
        lines += ["", *wrap(f"study {study.study}: {study.title}", width)]
        for text in study.summary:
            lines += _wrapped(text, width, "- ", "  ")
    for warning in _warnings(facts):
        lines += ["", *_paragraph(f"Warning: {warning}", width)]
    return lines + _commands(facts, run)


def _paragraph(text: str, width: int) -> list[str]:
    """Return the text wrapped, with its own line breaks and indents preserved.

    The line breaks are preserved because the text of an error possibly contains a small table.
    """
    lines: list[str] = []
    for line in text.splitlines():
        indent = " " * (len(line) - len(line.lstrip()))
        lines += _wrapped(line, width, "", indent)
    return lines


def _wrapped(text: str, width: int, first: str, others: str) -> list[str]:
    return wrap(
        text,
        width,
        initial_indent=first,
        subsequent_indent=others,
        break_long_words=False,  # a path split over two lines cannot be copied
        break_on_hyphens=False,
    )


def _warnings(facts: RunFacts) -> list[str]:
    told = facts.stop.get("problems")
    ending = map(str, told) if isinstance(told, list) else ()
    silent = filter(None, map(nrmse_warning, facts.judged_fits))
    models = (*failed_fits(facts), *facts.studies.warnings)
    return [*facts.problems, *ending, *weighing_warnings(facts), *models, *silent]


def _commands(facts: RunFacts, run: Path) -> list[str]:
    label = "resume" if facts.status in RESUMABLE else "next"
    commands = [(label, next_command(facts, str(run)))]
    if not _report(facts):
        commands.append(("next", f"hil report {run}"))
    return [f"{label}: {command}" for label, command in commands if command]


def _report(facts: RunFacts) -> str:
    page = facts.path / "report.html"
    return str(page) if page.is_file() else ""


def _details(facts: RunFacts) -> list[tuple[str, str]]:
    start, recorded = facts.start, facts.recorded
    out = [
        ("run", str(facts.path)),
        ("started", when(start.get("started"))),
        ("robot", facts.robot_title),
        ("operator", str(start.get("operator") or "")),
        ("part", facts.commissioning),
        ("program", _program(facts)),
        ("measured", facts.measured),
        ("unsettled", f"{len(facts.unsettled)} dwells" if facts.unsettled else ""),
        ("weighed", "; ".join(f"{load}: {told}" for load, told in weighings(facts).items())),
        ("verdict", verdict_words(facts)),
        *(("model", str(folder)) for folder in models_below(facts.path)),
        ("report", _report(facts)),
    ]
    if "samples" in recorded:
        took = duration(as_float(recorded.get("device_s")))
        missing = (
            f"{recorded.get('missing', 0)} missing in {counted(recorded.get('gaps', 0), 'gap')}"
        )
        twice = counted(recorded.get("duplicates", 0), "duplicate")
        samples = counted(recorded["samples"], "sample")
        out.insert(5, ("recorded", f"{samples} in {took}; {missing}, {twice}"))
        if late := recorded.get("overruns"):
            out.insert(6, ("late", f"{counted(late, 'sample')} came late ({LATE})"))
    return [(label, value) for label, value in out if value]


def _program(facts: RunFacts) -> str:
    if not facts.steps:
        return ""
    resumed = facts.stop.get("attempt")
    attempts = f", in {resumed + 1} attempts" if isinstance(resumed, int) and resumed else ""
    ended = f"; ended in {facts.ended_in}" if facts.ended_in else ""
    return f"{facts.steps_done} of {len(facts.steps)} steps{attempts}{ended}"


def _labelled(label: str, value: str, width: int) -> list[str]:
    return _wrapped(value, width, label.ljust(LABEL), " " * LABEL)


def _fit_lines(fit: FitFacts, width: int) -> list[str]:
    columns = [fit.values(metric) for metric in ("rmse_raw", "rmse_filtered", "noise_floor")]
    columns.append(fit.values("rmse_raw", "trained"))
    means = [fit.mean(metric) for metric in ("rmse_raw", "rmse_filtered", "noise_floor")]
    means.append(fit.mean("rmse_raw", "trained"))
    title = f"{fit.label}: RMSE [{fit.unit}] on held-out data, raw on trained"
    if np.isfinite(means[2]):
        title += f"; fast: the measured signal's {fit.fast_part}"
    lines = wrap(title, width)
    if not fit.is_honest:
        lines += wrap(f"not judged; {fit.protocol}", width)
    titles = [joint_title(j, name) for j, name in enumerate(fit.joint_names)]
    longest = max([NAMES, *(len(title) + APART for title in titles)])
    wide = COLUMN if width >= LABEL + 4 * COLUMN else NARROW
    names = max(0, min(longest, width - 4 * wide))
    lines += _row("joint", ["raw", "filtered", "fast", "trained"], names, wide)
    for j, title in enumerate(titles):
        lines += _row(title, [number(column[j]) for column in columns], names, wide)
    lines += _row("mean", [number(mean) for mean in means], names, wide)
    return lines + [line for row in fit.criteria for line in _criterion(row, width)]


def _row(name: str, values: list[str], names: int, wide: int) -> list[str]:
    """Return the text lines of one table row.

    A name that does not fit into its column is placed on a separate line and is not shortened.
    """
    cells = "".join(f"{value:>{wide}}" for value in values)
    if len(name) + APART > names:
        return [name, " " * names + cells]
    return [name.ljust(names) + cells]


def _criterion(row: object, width: int) -> list[str]:
    assert isinstance(row, dict)
    word = "pass" if row.get("passed") else "FAIL"
    found = number(as_float(row.get("value")))
    text = f"{word}  {criterion_text(row)}: {found} ({row.get('what')})"
    return wrap(text, width, subsequent_indent=" " * 6)
