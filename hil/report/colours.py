"""One visual language for every figure: colours by meaning, looks by the order of names.

Okabe & Ito, 'Color Universal Design' (2008): eight colours that people with every common form of
colour blindness tell apart. Theirs are for areas; as thin lines and small marks, some are too light
for white paper (contrast below 3:1, WCAG 2.2, 1.4.11). Those are darker here, and all of them as
far apart as that leaves room for, which `tests/report/test_figures.py` computes. Figures never rely
on colour alone: dashes, marks and patterns differ too.
"""

from __future__ import annotations

from collections.abc import Sequence

from hil.studies import Figure, Look

MEASURED = "#0072B2"
PREDICTED = "#AC3F00"
RESIDUAL = "#009E73"
LIMIT = "#B974A8"
NEUTRAL = "#595959"
UP = "#0072B2"
"""Poses approached from below."""
DOWN = "#CD7D00"
"""Poses approached from above."""

SELDOM, OFTEN = "#639ABF", "#003A5C"
"""Ends of the scale of counts: one hue, told apart by lightness."""

FILL = "#BFD9EA"
"""Of areas behind the data, whose edges are drawn in a colour that shows."""

JOINTS = ("#0072B2", "#CD7D00", "#009E73", "#AC3F00", "#B974A8", "#3493FF", "#595959")
DASHES = ("solid", "dash", "dot", "longdash", "dashdot", "longdashdot", "solid")
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x")

DARK = {
    "#0072B2": "#4DA3F7",
    "#AC3F00": "#FF7038",
    "#009E73": "#33F08F",
    "#B974A8": "#CE86C4",
    "#595959": "#A3A3A3",
    "#CD7D00": "#F2DC3A",
    "#3493FF": "#B8DFFF",
    "#639ABF": "#3A7CA5",
    "#003A5C": "#BDE3FF",
    "#BFD9EA": "#1F4E6B",
}
"""What each colour becomes on a dark page: the same hue, light enough to be read there."""

STROKES = {
    "solid": "",
    "dash": "5 3",
    "dot": "2.5 3.5",
    "longdash": "9 3",
    "dashdot": "6 2 2 2",
    "longdashdot": "9 2 2 2",
}
"""Each dash in a legend, as SVG has it."""

GLYPHS = {
    "circle": "●",
    "square": "■",
    "square-open": "□",
    "diamond": "◆",
    "diamond-open": "◇",
    "triangle-up": "▲",
    "triangle-up-open": "△",
    "triangle-down": "▼",
    "cross": "✚",
    "x": "✖",
}
"""Each mark in a legend."""

PALETTE = (MEASURED, PREDICTED, RESIDUAL, DOWN, LIMIT, JOINTS[5], NEUTRAL)
"""Of curves that have no look of their own."""

CURVE_SYMBOLS = (
    "circle",
    "square-open",
    "diamond",
    "triangle-up-open",
    "triangle-down",
    "diamond-open",
    "cross",
)
"""Full and open in turn: in a dense cloud shapes alone tell nothing."""

PATTERNS = ("", "/", "x", ".", "\\", "+", "-")

IDENTITY = Look(NEUTRAL, "dash", width=1.4)


def of_joint(j: int) -> Look:
    """Look of joint `j`, counted from 0: lines differ in print as well."""
    k = j % len(JOINTS)
    return Look(JOINTS[k], DASHES[k], SYMBOLS[k])


def look(i: int, line: int = 0) -> Look:
    """Look of the series `i` of a figure, which is its line number `line`, counted from 0."""
    return Look(
        PALETTE[i % len(PALETTE)],
        DASHES[line % len(DASHES)],
        CURVE_SYMBOLS[i % len(CURVE_SYMBOLS)],
        PATTERNS[i % len(PATTERNS)],
        width=1.5,
    )


def looks_of(figure: Figure, models: Sequence[str] = ()) -> dict[str, Look]:
    """Return a look for every name that has none of its own, the same in all panels.

    Curves that are not told apart by their name share a look; a line that is alone among lines is
    solid, whatever else there is.

    Args:
        figure: Its curves.
        models: Models that look as in the other figures of the page, in their order there; nothing
            else looks like one of them.
    """
    looks: dict[str, Look] = {name: look(i, i) for i, name in enumerate(models)}
    lines = 0
    for curve in (curve for panel in figure.panels for curve in panel.curves):
        if curve.name in looks or curve.look or curve.style == "identity":
            continue
        looks[curve.name] = look(len(looks), lines)
        lines += curve.style in ("line", "marked")
    return looks
