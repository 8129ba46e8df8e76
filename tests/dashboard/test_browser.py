"""The dashboard in a real browser: a run from start to Stop, by keys alone; every page looked at.

With HIL_SCREENSHOTS=FOLDER pictures of every page are kept there, in both themes and for a phone.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil.recording.run_directory import RunDirectory
from tests.support.browser.bench import SMALL, STATION, opened, serving
from tests.support.browser.looking import contrasts_below, enter, problems_of, tab_to, until
from tests.support.waiting import until as wait

pytestmark = [pytest.mark.wire, pytest.mark.timeout(240)]

STOPPED_WITHIN_S = 1.0
CLOCK = """
window.clock = {};
const standing = document.getElementById("standing");
addEventListener("keydown", (event) => { clock.pressed = event.timeStamp; });
new MutationObserver(() => {
  if (standing.textContent.includes("stopped")) clock.said ??= performance.now();
}).observe(standing, { childList: true, characterData: true, subtree: true });
"""
"""When Stop is pressed and when that it has stopped is read, by the page's own clock [ms]."""

PHONE = {"width": 390, "height": 844}
DESKTOP = {"width": 1280, "height": 900}


@pytest.fixture(scope="module")
def folder(dwell_lab: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Specs of a bench with a mock in wall time, and a run that has ended."""
    made = Path(shutil.copytree(dwell_lab, tmp_path_factory.mktemp("bench") / "lab"))
    (made / "specs").mkdir()
    (made / "specs" / "small.yaml").write_text(SMALL, "utf-8")
    (made / "specs" / "station.yaml").write_text(STATION, "utf-8")
    return made


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with serving(folder, "--specs", "specs") as there:
        yield there


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with opened() as one:
        yield one


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A page on which nothing may go wrong in silence."""
    new = browser.new_page(viewport=DESKTOP)
    said = problems_of(new)
    yield new
    new.close()
    assert said == []


def test_by_keys_alone_a_run_is_started_answered_and_stopped_within_a_second(
    page: Any, address: str, folder: Path
) -> None:
    page.goto(address)
    tab_to(page, "nav a[href='/start']")
    enter(page)
    tab_to(page, "select[name=spec]")
    page.keyboard.type("small")
    tab_to(page, "button[value=check]")
    enter(page)
    assert "Mount the weight" in page.inner_text("main")  # what it is going to ask
    tab_to(page, "button[value=start]")
    enter(page)
    page.wait_for_url("**/runs/**", timeout=60_000)

    page.wait_for_selector(".question:visible", timeout=60_000)
    assert "Remove everything from the flange" in page.inner_text(".question")
    tab_to(page, "button[value=yes]")
    until(page, "document.activeElement.getAttribute('aria-disabled') !== 'true'", 10)
    page.keyboard.press("Enter")
    until(page, "parseInt(document.querySelector('[data-text=percent]').textContent) > 0", 60)
    page.wait_for_selector(".question", state="hidden")
    tab_to(page, ".stopping button.stop")
    page.evaluate(CLOCK)
    page.keyboard.press("Enter")
    until(page, "window.clock.said", 30)
    seen_s = page.evaluate("(clock.said - clock.pressed) / 1000")

    run = RunDirectory(newest(folder))
    assert 0 < seen_s < STOPPED_WITHIN_S
    assert (run.stop or {})["outcome"] == "stopped"
    assert "dashboard" in (run.stop or {})["reason"]
    page.wait_for_selector("[data-shown=over]:visible", timeout=30_000)
    page.wait_for_selector(".stopping", state="detached")


def newest(folder: Path) -> Path:
    return max((folder / "runs").glob("*/ur5/*"), key=lambda run: run.stat().st_mtime)


def pages_of(folder: Path) -> dict[str, str]:
    """Every kind of page there is; a run that is live is looked at elsewhere."""
    ended = min((folder / "runs").glob("*/ur5/*")).relative_to(folder / "runs").as_posix()
    return {
        "overview": "/",
        "runs": "/runs",
        "run": f"/runs/{ended}",
        "report": f"/runs/{ended}/report",
        "models": "/models",
        "model": "/models/ur5",
        "version": "/models/ur5/v1",
        "schedules": "/schedules",
        "fleets": "/fleets",
        "start": "/start",
        "error": "/nothing",
    }


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_every_page_fits_can_be_read_and_says_nothing_at_the_console(
    browser: Any, address: str, folder: Path, theme: str, size: str
) -> None:
    viewport = DESKTOP if size == "desktop" else PHONE
    context = browser.new_context(color_scheme=theme, viewport=viewport)
    page, wrong = context.new_page(), []
    said = problems_of(page)
    for name, path in pages_of(folder).items():
        said.clear()
        page.goto(address.rstrip("/") + path)
        keep(page, f"{name}-{theme}-{size}")
        wide = page.evaluate("document.documentElement.scrollWidth")
        if wide > viewport["width"]:
            wrong.append(f"{name}: {wide} px wide")
        expected = "404" if name == "error" else None
        wrong += [f"{name}: {text}" for text in said if not (expected and expected in text)]
        if name != "report":  # its colours are tested with the reports
            wrong += [f"{name}: {text}" for text in contrasts_below(page, 4.5)]
    context.close()
    assert wrong == []


def test_nothing_is_needed_to_read_and_to_stop_but_html(
    browser: Any, address: str, folder: Path
) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(f"{address}start")
    page.select_option("select[name=spec]", "small.yaml")
    page.click("button[value=start]")
    page.wait_for_url("**/runs/**", timeout=60_000)  # by the page's own refreshing
    page.locator(".stopping button.stop").first.click()
    run = RunDirectory(newest(folder))
    wait(lambda: run.stop, 30)
    assert (run.stop or {})["outcome"] == "stopped"
    context.close()


@pytest.mark.journey
def test_read_only_there_is_nothing_to_press(browser: Any, folder: Path) -> None:
    with serving(folder, "--specs", "specs", "--read-only") as there:
        page = browser.new_page()
        for path in pages_of(folder).values():
            if path.endswith("/report") or path == "/start":
                continue
            page.goto(there.rstrip("/") + path)
            assert page.locator("form[method=post]").count() == 0, path
        page.close()


def keep(page: Any, name: str) -> None:
    if folder := os.environ.get("HIL_SCREENSHOTS"):
        page.wait_for_timeout(300)
        page.screenshot(path=str(Path(folder, f"{name}.png")), full_page=True)
