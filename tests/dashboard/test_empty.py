"""Where there is nothing to show, a page says what would fill it and the command that does."""

from __future__ import annotations

import html
import re
import shutil
from pathlib import Path

import pytest

from tests.support.paths import EXPERIMENTS

pytest.importorskip("starlette", reason='the dashboard: pip install "hil[web]"')

from tests.support import docs_commands
from tests.support.web_parts import dashboard, seen

WEEKLY = EXPERIMENTS / "reidentify_weekly.yaml"


def commands_in(page: str) -> list[str]:
    """What a page says to type, as it is copied."""
    told = re.findall(r'<pre tabindex="0" aria-label="Command"><code>(.*?)</code>', page, re.S)
    return [line for text in told for line in html.unescape(text).splitlines()]


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A folder with nothing in it, whose name has a blank."""
    folder = tmp_path / "my lab"
    (folder / "specs").mkdir(parents=True)
    return folder


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("address", "verbs"),
    [("/", ["run", "schedule run"]), ("/runs", ["run"]), ("/models", ["models register"]),
     ("/schedules", ["new re-identify", "schedule run"]), ("/fleets", ["fleet run"])],
)  # fmt: skip
def test_an_empty_page_says_what_fills_it(lab: Path, address: str, verbs: list[str]) -> None:
    told = commands_in(seen(dashboard(lab), address))
    assert all(line.startswith(f"hil {verb} ") or line == f"hil {verb}"
               for line, verb in zip(told, verbs, strict=True)), told  # fmt: skip
    for line in told:
        docs_commands.parse(line)


def test_a_schedule_that_was_never_started_says_how(lab: Path) -> None:
    for file in (
        WEEKLY,
        WEEKLY.with_name("ur5_probe.yaml"),
        WEEKLY.with_name("ur5_reidentify.yaml"),
    ):
        shutil.copy(file, lab / "specs")
    page = seen(dashboard(lab), "/schedules/ur5-weekly")
    history = page.split('id="history"')[1].split("<h2")[0]
    assert "never been started" in history
    (line,) = commands_in(history)
    assert line.startswith("hil schedule run ")
    docs_commands.parse(line)
