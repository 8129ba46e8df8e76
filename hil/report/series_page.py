"""The overview of a series: how its runs ended, their models, their studies side by side."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from hil.recording import SeriesGroup
from hil.report.documents import Document, as_objects, document
from hil.report.fit_facts import FitFacts, best_first, model_folders, read_fits
from hil.report.model_sections import HELD_OUT
from hil.report.page import Badge, Cell, Column, Mark, Page, Section, Table, cells, write_page
from hil.report.run_facts import read_studies
from hil.report.run_summary import ENDINGS, verdict_badge
from hil.report.study_sections import columns_of, is_numeric, protocol_mark
from hil.report.words import UNKNOWN, number, when
from hil.studies import Part, StudyResult
from hil.studies import Table as StudyTable

VERDICTS = {"passed": True, "rejected": False}


@dataclass(frozen=True, slots=True)
class SeriesRun:
    """One run of a series, as it stands on the disk.

    Attributes:
        name: Of the experiment, with the robot.
        entry: What the document of the series says.
        fits: Its models, best first.
        studies: What its studies found.
    """

    name: str
    entry: Document
    fits: tuple[FitFacts, ...]
    studies: tuple[StudyResult, ...]


def render_series(folder: Path) -> Path:
    """Write `series.html` into the folder of a series.

    Raises:
        DataError, RecordingError: The document cannot be read, or the page not be written.
    """
    return write_page(series_page(folder), SeriesGroup.page_in(folder))


def series_page(folder: Path) -> Page:
    """The page as blocks."""
    problems: list[str] = []
    # Not as a group: a page is made of a damaged document, too, and says what is wrong with it.
    head = document(SeriesGroup.document_in(folder), problems)
    runs = [_run(folder, entry, problems) for entry in as_objects(head.get(SeriesGroup.entries))]
    return Page(
        title=str(head.get("name", folder.name)),
        subtitle=f"Series of {len(runs)} runs, begun {when(head.get('started')) or UNKNOWN}",
        badge=_badge(runs),
        summary=str(head.get("description", "")),
        warnings=tuple(problems),
        sections=(
            Section(
                "runs",
                "Runs",
                "",
                (_runs_table(runs), *models_tables((run.name, run.fits) for run in runs)),
            ),
            *_study_sections(runs),
        ),
        footer=f"Made by hil {version('hil')} from {folder.resolve().name} and the run directories "
        "it names; their reports have the figures. It can be made again at any time: hil report.",
    )


def _run(folder: Path, entry: Document, problems: list[str]) -> SeriesRun:
    run = entry.get("run")
    name = f"{entry.get('experiment', UNKNOWN)} ({entry.get('robot', UNKNOWN)})"
    if not run:
        return SeriesRun(name, entry, (), ())
    path = folder / str(run)
    fits = best_first(read_fits(model_folders(path), problems))
    return SeriesRun(name, entry, fits, tuple(read_studies(path, problems).made))


def _badge(runs: Sequence[SeriesRun]) -> Badge:
    """The worst of the runs."""
    order: Sequence[Mark] = ("fail", "warn", "", "pass")
    badges = sorted((_verdict(run) for run in runs), key=lambda badge: order.index(badge.mark))
    return badges[0] if badges else Badge("NOT BEGUN", "warn")


def _verdict(run: SeriesRun) -> Badge:
    outcome = str(run.entry.get("outcome", ""))
    if not run.entry.get("run"):
        return Badge("NOT RUN", "fail")
    if outcome in ENDINGS:
        return Badge(*ENDINGS[outcome])
    return verdict_badge(VERDICTS.get(str(run.entry.get("verdict"))))


def _runs_table(runs: Sequence[SeriesRun]) -> Table:
    columns = (
        Column("experiment", number=False),
        Column("verdict", number=False),
        Column("samples"),
        Column("report", number=False),
        Column("what is wrong", number=False),
    )
    return Table("How each run ended", columns, tuple(_runs_row(run) for run in runs))


def _runs_row(run: SeriesRun) -> tuple[Cell, ...]:
    badge, error = _verdict(run), run.entry.get("error")
    wrong = str(error.get("message", "")) if isinstance(error, dict) else ""
    page = str(run.entry.get("report") or "")
    samples = str(run.entry.get("samples", UNKNOWN))
    report = Cell(page or UNKNOWN, link=page)
    return (
        Cell(run.name), Cell(badge.text.lower(), badge.mark), Cell(samples), report, Cell(wrong),
    )  # fmt: skip


def _study_sections(runs: Sequence[SeriesRun]) -> list[Section]:
    """Each part of the studies, its tables with the runs beside one another."""
    parts: dict[tuple[str, str], dict[str, list[tuple[str, StudyTable]]]] = {}
    for run, study, part in _parts(runs):
        mark = protocol_mark(part.protocol)
        title = f"{part.title} ({mark})" if mark else part.title
        tables = parts.setdefault((study, title), {})
        for table in part.tables:
            tables.setdefault(table.key, []).append((run, table))
    return [
        Section(
            f"part-{i}",
            title,
            f"Study {study}.",
            tuple(joined for shown in tables.values() for joined in side_by_side(shown)),
        )
        for i, ((study, title), tables) in enumerate(parts.items(), 1)
        if tables
    ]


def _parts(runs: Sequence[SeriesRun]) -> Iterator[tuple[str, str, Part]]:
    """Every part of every study, with the names of the run and of the study."""
    for run in runs:
        for study in run.studies:
            yield from ((run.name, study.study, part) for part in study.parts)


def side_by_side(shown: Sequence[tuple[str, StudyTable]]) -> list[Table]:
    """One table with a group of columns for each run, if the runs' tables have the same columns.

    Args:
        shown: Name of a run and its table, each.

    Returns:
        That table, or one below the other where columns differ. A row that a run does not have
        stays empty there.
    """
    first = shown[0][1]
    if any(table.columns != first.columns for _, table in shown):
        return [_joined([one]) for one in shown]
    return [_joined(shown)]


def _joined(shown: Sequence[tuple[str, StudyTable]]) -> Table:
    columns = [Column(shown[0][1].columns[0], number=False)]
    texts = [_by_row(table) for _, table in shown]
    keys = dict.fromkeys(key for one in texts for key in one)
    for run, table in shown:
        titles = enumerate(table.columns[1:], 1)
        columns += [Column(title, group=run, number=is_numeric(table, i)) for i, title in titles]
    empty = (UNKNOWN,) * (len(shown[0][1].columns) - 1)
    rows = tuple(
        (Cell(key[0]), *cells(*(text for one in texts for text in one.get(key, empty))))
        for key in keys
    )
    notes = dict.fromkeys(table.note for _, table in shown if table.note)
    return Table(shown[0][1].title, tuple(columns), rows, " ".join(notes))


def _by_row(table: StudyTable) -> dict[tuple[str, int], tuple[str, ...]]:
    """The texts of each row but its name, by the name and how often that has come before."""
    out: dict[tuple[str, int], tuple[str, ...]] = {}
    seen: Counter[str] = Counter()
    for name, *texts in zip(*columns_of(table), strict=True):
        out[name, seen[name]] = tuple(texts)
        seen[name] += 1
    return out


def models_tables(runs: Iterable[tuple[str, Sequence[FitFacts]]]) -> list[Table]:
    """Held-out errors of every model; no table where there is no model.

    Args:
        runs: Name of a run and its models, each.
    """
    columns = (
        Column("experiment", number=False),
        Column("model", number=False),
        Column("RMSE raw", HELD_OUT),
        Column("RMSE filtered", HELD_OUT),
        Column("unit", HELD_OUT, number=False),
    )
    rows = tuple(
        cells(name, fit.label, *_errors(fit), fit.unit or UNKNOWN)
        for name, fits in runs
        for fit in fits
    )
    return [Table("Errors of the models, means over the joints", columns, rows)] if rows else []


def _errors(fit: FitFacts) -> tuple[str, ...]:
    return tuple(number(fit.mean(metric)) for metric in ("rmse_raw", "rmse_filtered"))
