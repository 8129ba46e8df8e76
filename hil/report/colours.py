"""Colours, line styles and markers of all figures: colours by meaning, looks by curve names.

The colours derive from the palette of Okabe & Ito, 'Color Universal Design' (2008), whose eight
colours are distinguishable with every common form of colour blindness. The palette of Okabe & Ito
is intended for areas; for thin lines and small marks, some of its colours are too light on white
paper (contrast below 3:1, WCAG 2.2, 1.4.11). The light colours of the palette are darkened here,
while all colours remain as different from each other as possible (computed in
`tests/report/test_figures.py`). Figures never rely on colour alone: curves also differ in dash
pattern, mark or fill pattern.
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
"""Colour of poses that were approached from below."""
DOWN = "#CD7D00"
"""Colour of poses that were approached from above."""

SELDOM, OFTEN = "#639ABF", "#003A5C"
"""First and last colour of the scale of counts: one hue, from light to dark."""

FILL = "#BFD9EA"
"""Colour of areas behind the data; the edges of the areas have a colour of higher contrast."""

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
"""Colours on a dark page, by colour on a light page: the same hue, but bright enough to be
readable.
"""

STROKES = {
    "solid": "",
    "dash": "5 3",
    "dot": "2.5 3.5",
    "longdash": "9 3",
    "dashdot": "6 2 2 2",
    "longdashdot": "9 2 2 2",
}
"""Dash patterns of a legend, as SVG values of `stroke-dasharray`."""

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
"""Unicode characters that represent the marks in a legend."""

PALETTE = (MEASURED, PREDICTED, RESIDUAL, DOWN, LIMIT, JOINTS[5], NEUTRAL)
"""Colours of curves without an explicit look."""

CURVE_SYMBOLS = (
    "circle",
    "square-open",
    "diamond",
    "triangle-up-open",
    "triangle-down",
    "diamond-open",
    "cross",
)
"""Marks of curves without an explicit look, in the order of use: filled and open marks
alternate.

In a dense point cloud, the shape of a mark alone cannot be recognized.
"""

PATTERNS = ("", "/", "x", ".", "\\", "+", "-")

IDENTITY = Look(NEUTRAL, "dash", width=1.4)


def of_joint(j: int) -> Look:
    """Return the look of joint `j`, counted from 0.

    The dash patterns of the joints also differ, so that the lines are distinguishable in
    black-and-white print.
    """
    k = j % len(JOINTS)
    return Look(JOINTS[k], DASHES[k], SYMBOLS[k])


def look(i: int, line: int = 0) -> Look:
    """Return the look of series `i` of a figure.

    Args:
        i: Index of the series, counted from 0; the index selects colour, mark and pattern.
        line: Index of the series among the lines, counted from 0; this index selects the dash
            pattern.
    """
    return Look(
        PALETTE[i % len(PALETTE)],
        DASHES[line % len(DASHES)],
        CURVE_SYMBOLS[i % len(CURVE_SYMBOLS)],
        PATTERNS[i % len(PATTERNS)],
        width=1.5,
    )


def looks_of(figure: Figure, models: Sequence[str] = ()) -> dict[str, Look]:
    """Return a look for every curve name without an explicit look, the same look in all panels.

    Curves with the same name share a look. The first line of a figure is drawn solid, not dashed.

    Args:
        figure: Figure with the curves that need a look.
        models: Names of all models of the page, in the order of the page. A model has the same look
            in all figures of the page, and no other curve gets the look of a model.
    """
    looks: dict[str, Look] = {name: look(i, i) for i, name in enumerate(models)}
    lines = 0
    for curve in (curve for panel in figure.panels for curve in panel.curves):
        if curve.name in looks or curve.look or curve.style == "identity":
            continue
        looks[curve.name] = look(len(looks), lines)
        lines += curve.style in ("line", "marked")
    return looks
