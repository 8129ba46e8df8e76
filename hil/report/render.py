"""A `Page` to one HTML file that needs nothing else: no network, no neighbours."""

from __future__ import annotations

from collections.abc import Sequence
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
    from plotly.offline import get_plotlyjs

    css = files("hil.report").joinpath("report.css").read_text("utf-8")
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            page=page,
            dark=colours.DARK,
            strokes=colours.STROKES,
            css=Markup(css),  # noqa: S704 - our own file
            plotly=Markup(get_plotlyjs()),  # noqa: S704 - the installed library
        )
    )


def write_page(page: Page, path: Path) -> Path:
    """Write the page to `path`, whole or not at all; an older report there is replaced.

    Raises:
        RecordingError: The file cannot be written.
    """
    write_replacing(path, utf8_text(page_html(page)).encode())
    return path


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
