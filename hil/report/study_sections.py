"""Sections about studies: what a reader should take away, then all tables and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hil.report.curves import dressed
from hil.report.page import Block, Column, Facts, Notes, Paragraphs, Section, Table, cells, items
from hil.report.study_words import (
    HONEST,
    HONEST_MEANS,
    columns_of,
    distinct_titles,
    is_numeric,
    protocol_mark,
    short_titles,
)
from hil.report.words import duration, in_words
from hil.studies import Part, StudyResult
from hil.studies import Table as StudyTable

MOST_POINTS = 150_000
"""Of all series of a page together: about 2 MB, beside 2 MB of the plotting library."""
FEWEST, ENOUGH = 100, 1200
"""Points of one series: never fewer, and more than these no plot of the page can show."""


LONG = 20
"""Rows from which on a table comes after the figures: nobody reads on to them below it."""


def study_sections(studies: Sequence[StudyResult], models: Sequence[str] = ()) -> list[Section]:
    """For every study what it comes to, followed by its parts.

    Args:
        studies: What they found.
        models: Of the page, in its order: they look alike in all plots.
    """
    figures = [f for study in studies for part in study.parts for f in part.figures]
    curves = sum(len(panel.curves) for figure in figures for panel in figure.panels)
    points = max(FEWEST, min(ENOUGH, MOST_POINTS // max(1, curves)))
    titles = zip(distinct_titles(studies), short_titles(studies), strict=True)
    return [
        section
        for i, (study, (title, short)) in enumerate(zip(studies, titles, strict=True), 1)
        for section in _sections(f"study-{i}", study, points, models, title=title, short=short)
    ]


def _sections(
    name: str,
    study: StudyResult,
    points: int,
    models: Sequence[str],
    *,
    title: str,
    short: str,
) -> list[Section]:
    blocks: list[Block] = [Notes(study.summary)]
    asked = {key: in_words(value) for key, value in study.parameters.items()}
    blocks.append(Facts("How it was made", items({**asked, "took": duration(study.seconds)})))
    figures = [figure for part in study.parts for figure in part.figures]
    panels = [panel for figure in figures for panel in figure.panels]
    names = {panel.title for panel in panels} | {c.name for panel in panels for c in panel.curves}
    known = models if not names.isdisjoint(models) else ()
    parts = [_part(f"{name}-{i}", part, points, known) for i, part in enumerate(study.parts, 1)]
    if len(parts) == 1:
        parts = [replace(parts[0], short="")]
    first = Section(name, f"Study: {title}", "", tuple(blocks), short=f"Study: {short}")
    return [first, *parts]


def _part(name: str, part: Part, points: int, models: Sequence[str]) -> Section:
    mark = protocol_mark(part.protocol)
    blocks: list[Block] = [Paragraphs(part.text)] if part.text else []
    blocks += [_table(table) for table in part.tables if len(table.rows) < LONG]
    blocks += [dressed(figure, points, models) for figure in part.figures]
    blocks += [_table(table) for table in part.tables if len(table.rows) >= LONG]
    title = f"{part.title} ({mark})" if mark else part.title
    return Section(name, title, _lead(part.protocol), tuple(blocks))


def _lead(protocol: str) -> str:
    """What a protocol is, before anybody reads its numbers; a paper's are no predictions."""
    if not protocol:
        return ""
    if protocol == HONEST:
        return HONEST_MEANS
    return (
        f"Protocol {protocol}. These numbers are there to be compared with the paper's; they are "
        "no measure of how well a model predicts."
    )


def _table(table: StudyTable) -> Table:
    columns = tuple(
        Column(title, number=is_numeric(table, i)) for i, title in enumerate(table.columns)
    )
    rows = tuple(zip(*(cells(*column) for column in columns_of(table)), strict=True))
    return Table(table.title, columns, rows, table.note)
