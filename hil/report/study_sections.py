"""Sections about studies: what a reader should take away, then all tables and figures."""

from __future__ import annotations

from collections.abc import Sequence

from hil.report.blocks import Block, Column, Facts, Notes, Paragraphs, Section, Table, cells, items
from hil.report.study_curves import curve_count
from hil.report.study_figures import plots_of
from hil.report.study_words import (
    HONEST,
    columns_of,
    distinct_titles,
    is_numeric,
    protocol_mark,
)
from hil.report.words import duration, in_words
from hil.study import result as found

MOST_POINTS = 150_000
"""Of all series of a page together: about 2 MB, beside 5 MB of the plotting library."""
FEWEST, ENOUGH = 100, 1200
"""Points of one series: never fewer, and more than these no plot of the page can show."""


def study_sections(studies: Sequence[found.StudyResult]) -> list[Section]:
    """For every study what it comes to, followed by its parts."""
    figures = [f for study in studies for part in study.parts for f in part.figures]
    points = max(FEWEST, min(ENOUGH, MOST_POINTS // max(1, curve_count(figures))))
    titles = distinct_titles(studies)
    return [
        section
        for i, (study, title) in enumerate(zip(studies, titles, strict=True), 1)
        for section in _sections(f"study-{i}", study, title, points)
    ]


def _sections(name: str, study: found.StudyResult, title: str, points: int) -> list[Section]:
    blocks: list[Block] = [Notes(study.summary)]
    asked = {key: in_words(value) for key, value in study.parameters.items()}
    blocks.append(Facts("How it was made", items({**asked, "took": duration(study.seconds)})))
    parts = [_part(f"{name}-{i}", part, points) for i, part in enumerate(study.parts, 1)]
    return [Section(name, f"Study: {title}", "", tuple(blocks)), *parts]


def _part(name: str, part: found.Part, points: int) -> Section:
    mark = protocol_mark(part.protocol)
    blocks: list[Block] = [Paragraphs(part.text)] if part.text else []
    blocks += [_table(table) for table in part.tables]
    blocks += [plots_of(figure, points) for figure in part.figures]
    title = f"{part.title} ({mark})" if mark else part.title
    return Section(name, title, _lead(part.protocol), tuple(blocks))


def _lead(protocol: str) -> str:
    """Why numbers under a paper's protocol are no predictions, before anybody reads them."""
    if not protocol or protocol == HONEST:
        return ""
    return (
        f"Protocol {protocol}. These numbers are there to be compared with the paper's; they are "
        "no measure of how well a model predicts."
    )


def _table(table: found.Table) -> Table:
    columns = tuple(
        Column(title, number=is_numeric(table, i)) for i, title in enumerate(table.columns)
    )
    rows = tuple(zip(*(cells(*column) for column in columns_of(table)), strict=True))
    return Table(table.title, columns, rows, table.note)
