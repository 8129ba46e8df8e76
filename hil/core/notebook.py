"""HTML cards that show results in a notebook, with light and dark colours.

This module escapes all texts of a card for HTML. The colours of the cards are those of the reports
(a test compares them with the style sheet). The colour values are duplicated, because objects with
a card, such as a dataset, do not depend on the reports.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Literal

Tone = Literal["pass", "fail", "warn"]
Row = Sequence[object]

MARKS: dict[Tone, str] = {"pass": "✓", "fail": "✗", "warn": "!"}
"""Symbol of a badge by tone, because a badge must not be recognisable by its colour alone."""

LIGHT = {
    "ink": "#1b1f24", "muted": "#57606a", "page": "#ffffff", "raised": "#f5f7f9",
    "rule": "#d5dbe1", "pass": "#005c42", "pass-back": "#dcf3ea", "fail": "#9c2f00",
    "fail-back": "#fde8dc", "warn": "#6b4e00", "warn-back": "#fdf3d1",
}  # fmt: skip
DARK = {
    "ink": "#e8ebee", "muted": "#a7b0b9", "page": "#14181d", "raised": "#1d232a",
    "rule": "#39424c", "pass": "#6fe0b8", "pass-back": "#12382d", "fail": "#ffab80",
    "fail-back": "#43200f", "warn": "#f4d06f", "warn-back": "#3a2f0d",
}  # fmt: skip

MOST_ROWS = 12


def card(
    kind: str,
    title: object,
    facts: Mapping[str, object],
    *,
    badge: tuple[str, Tone] | None = None,
    table: tuple[Row, Iterable[Row]] | None = None,
    most: int = MOST_ROWS,
    picture: str = "",
    notes: Iterable[object] = (),
) -> str:
    """Return a card for one result as HTML.

    Args:
        kind: Kind of result that is shown, such as `Plan`.
        title: Name of the result that is shown.
        facts: Values that the card lists, by name and in this order; empty values are left out.
        badge: Text and tone of a badge; None for no badge.
        table: Header and rows of a table; None for no table.
        most: Maximum number of table rows that the card shows.
        picture: Picture as SVG text, embedded as an image so that its styles do not affect the
            page.
        notes: Additional notes, each a separate sentence.
    """
    parts = [f"<p class='hil-title'><span>{_text(kind)}</span> <b>{_text(title)}</b>"]
    if badge:
        word, tone = badge
        parts.append(f" <span class='hil-badge hil-{tone}'>{MARKS[tone]} {_text(word)}</span>")
    parts.append("</p>")
    if shown := {name: value for name, value in facts.items() if value not in ("", None)}:
        cells = (f"<div><dt>{_text(k)}</dt><dd>{_text(v)}</dd></div>" for k, v in shown.items())
        parts.append(f"<dl>{''.join(cells)}</dl>")
    if table:
        parts.append(_table(table[0], list(table[1]), most))
    if picture:
        data = base64.b64encode(picture.encode()).decode()
        label = _text(f"{kind} {title}")
        parts.append(f"<img alt='{label}' src='data:image/svg+xml;base64,{data}'>")
    parts += [f"<p class='hil-note'>{_text(note)}</p>" for note in notes]
    return f"<div class='hil-card'><style>{STYLE}</style>{''.join(parts)}</div>"


def number(value: float) -> str:
    """Return a number as text with three digits; a dash for NaN."""
    return "–" if value != value else f"{value:.3g}"


def _table(head: Row, rows: list[Row], most: int) -> str:
    top = "".join(f"<th scope='col'>{_text(cell)}</th>" for cell in head)
    body = "".join(f"<tr>{_cells(row)}</tr>" for row in rows[:most])
    rest = len(rows) - most
    more = f"<p class='hil-note'>… and {rest} more</p>" if rest > 0 else ""
    table = f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div class='hil-scroll'>{table}</div>{more}"


def _cells(row: Row) -> str:
    first, *others = row
    return f"<th scope='row'>{_text(first)}</th>" + "".join(f"<td>{_text(c)}</td>" for c in others)


def _text(value: object) -> str:
    return escape(str(value), quote=True)


def _colours(colours: Mapping[str, str]) -> str:
    return "".join(f"--hil-{name}:{value};" for name, value in colours.items())


def _style() -> str:
    dark = "{" + _colours(DARK) + "}"
    darkened = "[data-jp-theme-light='false'] .hil-card,.vscode-dark .hil-card"
    return (
        f".hil-card{{{_colours(LIGHT)}}}"
        "@media(prefers-color-scheme:dark){"
        f"body:not([data-jp-theme-light='true']):not(.vscode-light) .hil-card{dark}}}"
        f"{darkened}{dark}" + _LAYOUT
    )


_LAYOUT = """
.hil-card{box-sizing:border-box;max-width:60rem;margin:.4rem 0;padding:.6rem .9rem;
border:1px solid var(--hil-rule);border-radius:.5rem;background:var(--hil-page);
color:var(--hil-ink);font:14px/1.5 system-ui,sans-serif}
.hil-card p{margin:.2rem 0;overflow-wrap:anywhere}.hil-title span:first-child,.hil-card dt,
.hil-card .hil-note{color:var(--hil-muted);font-size:12px}
.hil-badge{padding:.1rem .5rem;border:1px solid currentColor;border-radius:.3rem;font-weight:650}
.hil-pass{color:var(--hil-pass);background:var(--hil-pass-back)}
.hil-fail{color:var(--hil-fail);background:var(--hil-fail-back)}
.hil-warn{color:var(--hil-warn);background:var(--hil-warn-back)}
.hil-card dl{display:flex;flex-wrap:wrap;gap:.25rem 1.5rem;margin:.35rem 0}
.hil-card dd{margin:0;font-variant-numeric:tabular-nums;overflow-wrap:anywhere}
.hil-scroll{overflow-x:auto}.hil-card table{border-collapse:collapse;margin:.3rem 0;font-size:13px;
color:inherit;font-variant-numeric:tabular-nums;border:0}
.hil-card th,.hil-card td{padding:.15rem .6rem;border:0;border-bottom:1px solid var(--hil-rule);
text-align:right;background:none;color:inherit;font-weight:400}
.hil-card thead th{font-weight:600}.hil-card th:first-child{text-align:left}
.hil-card img{display:block;width:100%;margin:.4rem 0}
""".replace("\n", "")

STYLE = _style()
