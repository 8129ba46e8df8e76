"""One visual language for every plot: colours by meaning, from the Okabe–Ito palette.

Okabe & Ito, 'Color Universal Design' (2008): eight colours that people with every common form of
colour blindness tell apart. Plots never rely on colour alone: dashes and marker shapes differ too.
"""

from __future__ import annotations

MEASURED = "#0072B2"
PREDICTED = "#D55E00"
RESIDUAL = "#009E73"
LIMIT = "#CC79A7"
NEUTRAL = "#595959"
UP = "#0072B2"
"""Poses approached from below."""
DOWN = "#E69F00"
"""Poses approached from above."""

SELDOM, OFTEN = "#BFD9EA", "#003A5C"
"""Ends of the scale of counts: one hue, told apart by lightness."""

JOINTS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#595959")
DASHES = ("solid", "dash", "dot", "longdash", "dashdot", "longdashdot", "solid")
SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "cross", "x")

DARK = {
    "#0072B2": "#56B4E9",
    "#D55E00": "#FF8A3C",
    "#009E73": "#2CCB9B",
    "#CC79A7": "#E5A3C7",
    "#595959": "#B3B3B3",
    "#E69F00": "#F2B733",
    "#56B4E9": "#A9D9F5",
    "#BFD9EA": "#1F4E6B",
    "#003A5C": "#BDE3FF",
}
"""What each colour becomes on a dark page: the same hue, light enough to be read there."""


def of_joint(j: int) -> str:
    """Colour of joint `j`, counted from 0."""
    return JOINTS[j % len(JOINTS)]


def dash_of_joint(j: int) -> str:
    """Line style of joint `j`, so that lines differ in print as well."""
    return DASHES[j % len(DASHES)]


def symbol_of_joint(j: int) -> str:
    """Marker of joint `j`."""
    return SYMBOLS[j % len(SYMBOLS)]
