"""A `Page` to one HTML file that needs nothing else: no network, no neighbours.

plotly.js is inside, compressed to 2.0 MB from 4.8 MB: a report is one file that can be mailed,
opened from a read-only share and served by the dashboard. A file shared by all runs of a folder
would be lost with the first report that is copied elsewhere.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from hil.core import utf8_text, write_replacing
from hil.report import colours
from hil.report.blocks import Page, Section
from hil.report.encode import figure_json

if TYPE_CHECKING:
    from jinja2 import Environment


def page_html(page: Page) -> str:
    """The page as HTML; every text of it is escaped."""
    from markupsafe import Markup

    css = files("hil.report").joinpath("report.css").read_text("utf-8")
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            page=page,
            dark=colours.DARK,
            strokes=colours.STROKES,
            css=Markup(css),  # noqa: S704 - our own file
            plotly=packed_plotly,
        )
    )


def write_page(page: Page, path: Path) -> Path:
    """Write the page to `path`, whole or not at all; an older report there is replaced.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_replacing(path, utf8_text(page_html(page)).encode())
    return path


@cache
def packed_plotly() -> str:
    """plotly.js as base64 of gzip, which every browser since 2023 unpacks by itself."""
    from plotly.offline import get_plotlyjs

    # A time of zero: equal pages are equal files.
    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode("ascii")


def _environment() -> Environment:
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    folder = files("hil.report")
    environment = Environment(
        loader=FunctionLoader(lambda name: folder.joinpath(name).read_text("utf-8")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["figure_json"] = lambda figure: Markup(figure_json(figure))  # noqa: S704
    environment.filters["plotted"] = _plotted
    return environment


def _plotted(sections: Sequence[Section]) -> bool:
    """Whether any section has a plot; plotly.js is left out of pages that have none."""
    return any(block.kind == "plots" for section in sections for block in section.blocks)
