"""One visual language for every plot: colours by meaning, from the Okabe–Ito palette.

Okabe & Ito, 'Color Universal Design' (2008): eight colours that people with every common form of
colour blindness tell apart. Theirs are for areas; as thin lines and small marks, some are too light
for white paper (contrast below 3:1, WCAG 2.2, 1.4.11). Those are darker here, and all of them as
far apart as that leaves room for, which `tests/test_report_colours.py` computes. Plots never rely
on colour alone: dashes and marker shapes differ too.
"""

from __future__ import annotations

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


def of_joint(j: int) -> str:
    """Colour of joint `j`, counted from 0."""
    return JOINTS[j % len(JOINTS)]


def dash_of_joint(j: int) -> str:
    """Line style of joint `j`, so that lines differ in print as well."""
    return DASHES[j % len(DASHES)]


def symbol_of_joint(j: int) -> str:
    """Marker of joint `j`."""
    return SYMBOLS[j % len(SYMBOLS)]
