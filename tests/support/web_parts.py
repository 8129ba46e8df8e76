"""The dashboard as a test asks it, and what every page of it keeps to."""

from __future__ import annotations

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from starlette.testclient import TestClient

from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings
from tests.support.recorded import SLY


def dashboard(folder: Path, **more: Any) -> TestClient:
    """A dashboard of the runs, models, schedules and specs below a folder."""
    given = {"runs": folder / "runs", "registry": folder / "registry", "port": 8350,
             "schedules": folder / "schedules", "specs": folder / "specs"}  # fmt: skip
    made = create_app(Settings(**{**given, **more}))
    return TestClient(made, base_url="http://127.0.0.1:8350", headers={"accept": "text/html"})


def address_of_run(run: Path, lab: Path) -> str:
    """Where its page is."""
    return f"/runs/{run.relative_to(lab / 'runs').as_posix()}"


def failing(error: Exception) -> Callable[..., None]:
    """Something that only raises."""

    def fails(*arguments: object) -> None:
        raise error

    return fails


def seen(client: TestClient, address: str, status: int = 200) -> str:
    """A page that keeps to what all do."""
    answer = client.get(address)
    assert answer.status_code == status, answer.text[:2000]
    require_fit_for_all(answer.text)
    return answer.text


def plain(html: str) -> str:
    """Text of a page, blanks as one."""
    return " ".join(re.sub(r"<[^>]+>", " ", html).split())


def require_fit_for_all(html: str) -> None:
    """No script or style that the policy forbids; tables and charts that can be read aloud."""
    assert SLY not in html
    reader = _Reader()
    reader.feed(html)
    assert reader.faults == []


class _Reader(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []
        self._tables: list[bool] = []
        self._ids: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look at a tag."""
        given = dict(attrs)
        self.faults += [f"{tag} {name}" for name in given if name == "style" or name[:2] == "on"]
        if tag == "style" or (tag == "script" and "src" not in given):
            self.faults.append(f"{tag} in the page")
        if (name := given.get("id")) is not None:
            self.faults += [f"id {name} twice"] if name in self._ids else []
            self._ids.add(name)
        if tag == "div" and "scroll" in (given.get("class") or "").split():
            named = given.get("tabindex") == "0" and given.get("aria-label")
            self.faults += [] if named and given.get("role") == "region" else ["scroll by mouse"]
        if tag == "svg" and not (given.get("role") == "img" and given.get("aria-labelledby")):
            self.faults.append("svg without a name")
        if tag == "th" and "scope" not in given:
            self.faults.append("th without scope")
        if tag == "table":
            self._tables.append(False)
        if tag == "caption":
            self._tables[-1] = True

    def handle_endtag(self, tag: str) -> None:
        """A table has ended."""
        if tag == "table" and not self._tables.pop():
            self.faults.append("table without caption")
