"""Reads report pages for the tests: what they would load, what they say, what their tables hold."""

from __future__ import annotations

import base64
import json
from html.parser import HTMLParser
from typing import Any

import numpy as np

VOID = {"meta", "link", "img", "br", "input", "hr", "source", "base"}
LOADING = {"src", "href", "srcset", "data", "poster", "action", "background", "xlink:href"}


class Page(HTMLParser):
    """A parsed page.

    `loads` are all attribute values a browser might fetch or navigate to, `figures` the decoded
    plotly figures, `tables` caption → rows of texts, `text` everything a reader sees.
    """

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.loads: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.ids: list[str] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.styles: list[str] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.pieces: list[str] = []
        self._open: list[str] = []
        self._attrs: dict[str, str | None] = {}
        self._caption = ""
        self._rows: list[list[str]] = []
        self.feed(html)
        self.close()

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.pieces).split())

    @property
    def figures(self) -> list[dict[str, Any]]:
        kind = "application/json"
        found = [json.loads(text) for attrs, text in self.scripts if attrs.get("type") == kind]
        return [figure for figure in found if "layout" in figure]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.tags.append((tag, named))
        self.loads += [value or "" for name, value in attrs if name in LOADING]
        if named.get("id"):
            self.ids.append(str(named["id"]))
        if tag not in VOID:
            self._open.append(tag)
        self._attrs = named
        if tag == "script":
            self.scripts.append((named, ""))
        if tag == "table":
            self._caption, self._rows = "", []
        if tag == "tr":
            self._rows.append([])
        if tag in ("td", "th"):
            self._rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag, f"</{tag}> closes nothing"
        if tag == "table":
            self.tables[self._caption.strip()] = self._rows

    def handle_data(self, data: str) -> None:
        inside = self._open[-1] if self._open else ""
        if inside == "script":
            attrs, text = self.scripts[-1]
            self.scripts[-1] = (attrs, text + data)
            return
        if inside == "style":
            self.styles.append(data)
            return
        self.pieces.append(data)
        if "caption" in self._open:
            self._caption += data
        elif "td" in self._open or ("th" in self._open and self._rows):
            self._rows[-1][-1] += data


def array_of(value: Any) -> np.ndarray:
    """The numbers of a trace, however they are encoded."""
    if isinstance(value, dict):
        flat = np.frombuffer(base64.b64decode(value["bdata"]), dtype=value["dtype"])
        if "shape" in value:
            return flat.reshape([int(n) for n in value["shape"].split(",")])
        return flat
    return np.array(value, dtype=float)
