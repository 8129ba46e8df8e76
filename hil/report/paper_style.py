"""How figures for papers look: sizes in print, fonts, and what matplotlib calls our looks."""

from __future__ import annotations

from typing import Any

MM = 1 / 25.4
"""One millimetre [inch]."""

LETTER = 1.25
"""Width of a letter of an axis title or legend, on average [mm]."""

WIDTHS = {"column": 88.0, "page": 181.0}
"""Of a figure [mm]: one column, or the whole page, of the journals of the field."""

LEAST_PANEL = 40.0
"""Narrower panels are moved to the next row [mm]."""

STYLE: Any = {
    "font.family": "DejaVu Sans",  # comes with matplotlib, so that every machine draws the same
    "font.size": 6.5,
    "axes.titlesize": 7,
    "axes.labelsize": 6.5,
    "axes.labelpad": 2,
    "axes.titlepad": 3,
    "xtick.labelsize": 6,
    "ytick.labelsize": 6,
    "xtick.major.size": 2,
    "ytick.major.size": 2,
    "xtick.major.pad": 1.5,
    "ytick.major.pad": 1.5,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "axes.linewidth": 0.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E3E3E3",
    "grid.linewidth": 0.4,
    "legend.fontsize": 6.5,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "legend.columnspacing": 1.2,
    "lines.linewidth": 0.9,
    "lines.markersize": 2.2,
    "hatch.linewidth": 0.4,
    "text.parse_math": False,  # a dollar sign in a title is one
    "axes.unicode_minus": True,
    "pdf.fonttype": 42,  # TrueType inside: publishers refuse bitmaps of letters
    "svg.fonttype": "path",
    "svg.hashsalt": "hil",
    "savefig.dpi": 600,
    "axes.formatter.useoffset": False,
}

LINES: dict[str, Any] = {
    "solid": "-",
    "dash": (0, (4, 1.5)),
    "dot": (0, (1, 1.2)),
    "longdash": (0, (7, 2)),
    "dashdot": (0, (4, 1.2, 1, 1.2)),
    "longdashdot": (0, (7, 1.5, 1, 1.5)),
}
MARKS = {
    "circle": "o",
    "square": "s",
    "diamond": "D",
    "triangle-up": "^",
    "triangle-down": "v",
    "cross": "P",
    "x": "x",
    "line-ew": "_",
}
"""Of what plotly calls `square`, or `square-open` when it is only an outline."""
HATCHES = {"": "", "/": "/////", "x": "xxxxx", ".": ".....", "\\": "\\\\\\\\\\", "+": "+++++",
           "-": "-----"}  # fmt: skip

METADATA: dict[str, dict[str, Any]] = {
    "pdf": {"CreationDate": None, "Producer": None, "Creator": "hil"},
    "svg": {"Date": None, "Creator": "hil"},
    "png": {"Software": None},
}
"""No times and versions: an equal figure is an equal file."""
