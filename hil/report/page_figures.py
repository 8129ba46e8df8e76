"""The figures of a page that hil wrote, read back from it: what they show stands in the file."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

from hil.core import DataError
from hil.report.figure_shape import checked_figure


@dataclass(frozen=True, slots=True)
class PagePanel:
    """One plot of a page.

    Attributes:
        title: Above it.
        figure: As `report.figures` made it, arrays of float32.
        wide: Whether it takes the whole width.
    """

    title: str
    figure: dict[str, Any]
    wide: bool

    @property
    def x_title(self) -> str:
        """Of its x axis, with unit."""
        return _axis_title(self.figure, "xaxis")

    @property
    def y_title(self) -> str:
        """Of its y axis, with unit."""
        return _axis_title(self.figure, "yaxis")


@dataclass(frozen=True, slots=True)
class PagePlots:
    """Plots that stand side by side under one heading.

    Attributes:
        section: Id of the section they are in.
        place: Heading of that section.
        title: Their own heading.
        panels: In reading order.
    """

    section: str
    place: str
    title: str
    panels: tuple[PagePanel, ...]


def figures_of(page: Path) -> list[PagePlots]:
    """All plots of a page.

    Raises:
        DataError: The file cannot be read, is no page of hil, or one without plots.
    """
    try:
        text = page.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(
            f"{page} cannot be read: {error}", hint="see whether it exists and may be read"
        ) from error
    reader = _Reader()
    try:
        reader.feed(text)
        reader.close()
        found = reader.found()
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise DataError(
            f"{page} is no page of hil, or damaged: {error}",
            hint="make the page anew: hil report RUN",
        ) from error
    if not found:
        raise DataError(f"{page} has no plots", hint="give a page that hil wrote, or a run")
    return found


class _Reader(HTMLParser):
    """Collects headings, captions and the documents beside the plots."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self._plots: list[tuple[str, str, str, list[PagePanel]]] = []
        self._section = self._place = self._title = self._caption = self._open = ""
        self._wide = False
        self._text: list[str] = []

    def found(self) -> list[PagePlots]:
        """What has been read; plots that take the whole width are figures of their own."""
        out = []
        for section, place, title, panels in self._plots:
            if len(panels) > 1 and all(panel.wide for panel in panels):
                out += [PagePlots(section, place, panel.title, (panel,)) for panel in panels]
            elif panels:
                out.append(PagePlots(section, place, title, tuple(panels)))
        return out

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        if tag == "h2":
            self._section = named.get("id") or ""
        if tag == "figure":
            self._wide = "wide" in (named.get("class") or "").split()
        if tag in ("h2", "h3", "figcaption") or (
            tag == "script" and named.get("type") == "application/json" and "id" not in named
        ):
            self._open, self._text = tag, []

    def handle_data(self, data: str) -> None:
        if self._open:
            self._text.append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag != self._open:
            return
        text, self._open = "".join(self._text), ""
        if tag == "h2":
            self._place = text
        elif tag == "h3":
            self._title = text
            self._plots.append((self._section, self._place, text, []))
        elif tag == "figcaption":
            self._caption = text
        else:
            self._plots[-1][3].append(
                PagePanel(self._caption, _figure(text, self._caption), self._wide)
            )


def _figure(text: str, title: str) -> dict[str, Any]:
    """The document of one plot. Raises `ValueError` that names the plot."""
    try:
        return checked_figure(_arrays(json.loads(text)))
    except (ValueError, TypeError) as error:
        raise ValueError(f"in the plot {title!r}: {error}") from error


def _arrays(value: Any) -> Any:
    """A document with its packed arrays as arrays again."""
    if isinstance(value, list):
        return [_arrays(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "bdata" in value:
        packed = np.frombuffer(base64.b64decode(value["bdata"]), "<f4").astype(np.float64)
        shape = [int(n) for n in str(value.get("shape", packed.size)).split(",")]
        return packed.reshape(shape)
    return {key: _arrays(item) for key, item in value.items()}


def _axis_title(figure: dict[str, Any], axis: str) -> str:
    return unescape(str(figure["layout"][axis]["title"]["text"]))
