"""The dashboard in a real browser: a run by keys alone, every page, and live runs in trouble.

With HIL_SCREENSHOTS=FOLDER pictures of every page are kept there, in both themes and for a phone.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from hil.recording.run_directory import RunDirectory
from hil.workflow.background_runs import Started, ticks_of
from tests.support.browser.bench import SMALL, STATION, opened, served, serving
from tests.support.browser.looking import contrasts_below, enter, problems_of, tab_to, until
from tests.support.live_run import live_run
from tests.support.waiting import until as wait

# The dashboard in a real browser: a run from start to Stop, by keys alone; every page looked at


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


@pytest.mark.wire
@pytest.mark.timeout(240)
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


@pytest.mark.wire
@pytest.mark.timeout(240)
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


@pytest.mark.wire
@pytest.mark.timeout(240)
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


@pytest.mark.wire
@pytest.mark.timeout(240)
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


# Live runs in a browser when things are not well: many pages, a hung dashboard, a hung run


PAGES = 10
"""More than the six connections that a browser keeps to a host."""
WITHIN_S = 20.0
"""For what comes some time: computers are busy. What is promised has a bound of its own."""
OLD_WITHIN_S = 10.0
BANNER = "document.getElementById('old').textContent"
SAMPLES = "Number(document.querySelector('[data-text=samples]').textContent.replace(/[^0-9]/g, ''))"
QUESTION = ".question button[value=yes]"
FREE = f"document.querySelector('{QUESTION}').getAttribute('aria-disabled') === 'false'"
TELLS = """
const refused = document.querySelector(".stopping .refused");
new MutationObserver(() => console.log(refused.textContent)).observe(refused, { childList: true });
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, Any]]:
    """A folder, the address of its dashboard and that dashboard's process."""
    folder = tmp_path_factory.mktemp("live")
    with served(folder) as (address, process):
        yield folder, address, process


@pytest.fixture
def live_page(browser: Any, bench: Bench) -> Iterator[Any]:
    context = browser.new_context()
    context.set_default_timeout(20_000)
    yield context.new_page()
    bench[2].send_signal(signal.SIGCONT)
    context.close()


Bench = tuple[Path, str, Any]


def address_of(run: Path, bench: Bench) -> str:
    folder, address, _ = bench
    return f"{address}runs/{run.relative_to(folder / 'runs').as_posix()}"


def outcome(run: Path) -> Any:
    return (RunDirectory(run).stop or {}).get("outcome")


def refuse(status: int, route: Any) -> None:
    route.fulfill(status=status, body="no")


def text_of(live_page: Any, selector: str) -> str:
    return str(live_page.evaluate("(s) => document.querySelector(s).textContent", selector))


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_ten_pages_of_a_run_are_kept_up_to_date_and_stop_acts_in_the_last(
    live_page: Any, bench: Bench
) -> None:
    with live_run(bench[0] / "runs") as (run, _):
        pages = [live_page, *(live_page.context.new_page() for _ in range(PAGES - 1))]
        for one in pages:
            one.goto(address_of(run, bench))
        shown = pages[-1].evaluate(SAMPLES)
        for one in pages:
            assert one.evaluate("document.visibilityState") == "visible"
            until(one, f"{SAMPLES} > {shown}", WITHIN_S)
        pages[0].close()  # it held the stream for all
        pages[-1].click(".stopping button.stop")
        wait(lambda: outcome(run), WITHIN_S)
        for one in pages[1:]:
            until(
                one, "document.getElementById('standing').textContent.includes('stopped')", WITHIN_S
            )


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_a_hung_dashboard_is_said_and_stop_is_asked_for_again(live_page: Any, bench: Bench) -> None:
    folder, _, process = bench
    with live_run(folder / "runs") as (run, _):
        live_page.goto(address_of(run, bench))
        live_page.wait_for_timeout(500)
        assert live_page.evaluate(BANNER) == ""
        process.send_signal(signal.SIGSTOP)
        until(live_page, f"{BANNER}.startsWith('No data from the dashboard for ')", OLD_WITHIN_S)
        assert live_page.evaluate("document.body.classList.contains('old')")
        process.send_signal(signal.SIGCONT)
        until(live_page, f"{BANNER} === ''", WITHIN_S)

        process.send_signal(signal.SIGSTOP)
        # Of a page that is being left the driver tells nothing; its console it does.
        live_page.evaluate(TELLS)
        with live_page.expect_console_message(lambda told: "been accepted" in told.text) as refused:
            live_page.evaluate("document.querySelector('.stopping button.stop').click()")
            assert text_of(live_page, ".stopping .said") == "stopping …"
        assert "“Stop” may not have been accepted: no answer" in refused.value.text
        assert "robot’s own button" in refused.value.text
        with live_page.expect_navigation(timeout=20_000):  # asked once more, as without scripts
            process.send_signal(signal.SIGCONT)
        wait(lambda: outcome(run) == "stopped", WITHIN_S)


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_a_refusal_is_said_at_the_button_and_a_refused_stream_is_asked_for_again(
    live_page: Any, bench: Bench
) -> None:
    with live_run(bench[0] / "runs") as (run, _):
        live_page.route("**/events*", partial(refuse, 500))
        live_page.goto(address_of(run, bench))
        until(live_page, f"{BANNER} !== ''", WITHIN_S)
        live_page.unroute("**/events*")
        until(live_page, f"{BANNER} === ''", WITHIN_S)
        for status in (401, 403, 500):
            live_page.route("**/stop", partial(refuse, status))
            live_page.click("main button.stop")
            refused = f"was NOT accepted: {status}"
            told = "document.querySelector('main .stop ~ .refused').textContent"
            until(live_page, f"{told}.includes('{refused}')", WITHIN_S)
            live_page.unroute("**/stop")
        live_page.click("main button.stop")
        wait(lambda: outcome(run) == "stopped", WITHIN_S)


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_a_hung_run_is_told_apart_in_the_header_and_on_the_overview(
    live_page: Any, bench: Bench
) -> None:
    with live_run(bench[0] / "runs") as (_, process):
        live_page.goto(bench[1])
        live_page.wait_for_selector(".stopping")
        assert live_page.locator(".silent").count() == 0
        process.send_signal(signal.SIGSTOP)
        for where in (".stopping", ".card"):
            live_page.wait_for_selector(f"{where} .silent", timeout=20_000)
            assert "no data for " in live_page.inner_text(f"{where} .silent")
        assert live_page.evaluate(BANNER) == ""  # the dashboard itself is well
        process.send_signal(signal.SIGCONT)
        until(live_page, "!document.querySelector('.silent')", WITHIN_S)


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_a_question_takes_no_answer_before_anybody_can_have_read_it(
    live_page: Any, bench: Bench
) -> None:
    posted = []
    live_page.on("request", lambda one: posted.append(one.url) if one.method == "POST" else None)
    press = f"document.querySelector('{QUESTION}').click()"
    with live_run(bench[0] / "runs", "Mount the weight", "twice") as (run, _):
        # By the page's own clock: the driver may be late.
        live_page.add_init_script(
            "addEventListener('DOMContentLoaded', () => setTimeout(() => {"
            f" window.free = {FREE}; {press}; }}, 300))"
        )
        live_page.goto(address_of(run, bench))
        until(live_page, "'free' in window", WITHIN_S)
        assert live_page.evaluate("window.free") is False
        until(live_page, FREE, WITHIN_S)
        live_page.focus(QUESTION)
        live_page.evaluate(f"{press}; {press}; {press}")
        first = live_page.evaluate("document.querySelector('[name=asked]').value")
        changed = f"document.querySelector('[name=asked]').value !== '{first}'"
        live_page.evaluate(
            f"() => {{ const looking = setInterval(() => {{ if (!({changed})) return;"
            f" clearInterval(looking); setTimeout(() => {{ {press}; window.late = true; }}, 300);"
            " }, 5); }"
        )
        until(live_page, "window.late", WITHIN_S)
        assert live_page.evaluate("document.activeElement.matches('button[value=yes]')")
        until(live_page, FREE, WITHIN_S)
        assert len(posted) == 1
        live_page.evaluate(press)
        live_page.wait_for_selector(".question", state="hidden")
        assert len(posted) == 2


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_pause_and_resume_follow_the_run_and_the_keyboard_stays_where_it_is(
    live_page: Any, bench: Bench
) -> None:
    def free(what: str) -> str:
        return f"document.querySelector('[data-can={what}]').ariaDisabled !== 'true'"

    with live_run(bench[0] / "runs") as (run, _):
        live_page.goto(address_of(run, bench))
        until(live_page, f"{free('pause')} && !({free('resume')})", WITHIN_S)
        live_page.focus("[data-can=pause]")
        live_page.keyboard.press("Enter")
        until(live_page, f"!({free('pause')}) && {free('resume')}", WITHIN_S)
        assert live_page.evaluate("document.activeElement.dataset.can") == "pause"
        live_page.keyboard.press("Tab")
        assert live_page.evaluate("document.activeElement.dataset.can") == "resume"
        live_page.keyboard.press("Enter")
        until(live_page, f"{free('pause')} && !({free('resume')})", WITHIN_S)
        assert live_page.evaluate("document.activeElement.dataset.can") == "resume"
        live_page.keyboard.press("Enter")  # nothing is asked
        live_page.wait_for_timeout(200)
        assert text_of(live_page, "[data-can=resume] ~ .said") == ""


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_what_is_being_planned_comes_and_goes_in_the_header_of_every_page(
    live_page: Any, bench: Bench
) -> None:
    folder, address, _ = bench
    live_page.goto(f"{address}models")
    with being_planned(folder, "1", "2"):
        until(live_page, "document.querySelector('#live .planned .how')", WITHIN_S)
        told = " ".join(text_of(live_page, "#live .planned").split())
        name = "asks_for_a_rather_long_while.yaml"
        assert told == f"{name} is being planned Cancel {name}"
        live_page.set_viewport_size({"width": 390, "height": 800})
        box = live_page.locator("#live .planned").first.bounding_box()
        assert box["width"] > 340, "one below the other on a phone"
        assert box["height"] < 80
        live_page.focus("#live .planned button")
    until(live_page, "!document.querySelector('#live .planned')", WITHIN_S)
    assert live_page.evaluate("document.activeElement.id") == "main"


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_the_keyboard_stays_at_cancel_while_a_run_is_planned(live_page: Any, bench: Bench) -> None:
    folder, address, _ = bench
    with being_planned(folder, "17") as planning:
        log = folder / "runs" / ".started" / "17.log"
        log.write_text("reads the spec\n")
        live_page.goto(f"{address}start/17")
        live_page.evaluate("window.same = true")
        live_page.focus("main button.stop")
        log.write_text("reads the spec\nplans\n")
        until(
            live_page, "document.getElementById('printed').textContent.includes('plans')", WITHIN_S
        )
        assert live_page.evaluate(
            "window.same && document.activeElement.matches('main button.stop')"
        )
        planning.kill()
        planning.wait()
        live_page.wait_for_selector("text=did not start")
        assert live_page.locator("main button.stop").count() == 0
        assert "plans" in live_page.inner_text("#printed")


@contextlib.contextmanager
def being_planned(folder: Path, *ids: str) -> Iterator[subprocess.Popen[bytes]]:
    """Records of a process that seems to plan, under some names; it and they are gone after it."""
    records = [folder / "runs" / ".started" / f"{one}.json" for one in ids]
    records[0].parent.mkdir(parents=True, exist_ok=True)
    with subprocess.Popen(["sleep", "60"]) as planning:
        said = Started(
            id="", runs="", spec="asks_for_a_rather_long_while.yaml", station="", operator="anna",
            pid=planning.pid, ticks=ticks_of(planning.pid), time=time.time(), host=platform.node(),
        )  # fmt: skip
        for record in records:
            record.write_text(json.dumps(asdict(said)))
        try:
            yield planning
        finally:
            planning.kill()
            for record in records:
                record.unlink()


@pytest.mark.wire
@pytest.mark.timeout(120)
def test_too_many_pages_are_told_apart_from_a_dashboard_that_is_gone(
    live_page: Any, bench: Bench
) -> None:
    live_page.route("**/events*", partial(refuse, 503))
    live_page.goto(bench[1])
    until(live_page, f"{BANNER}.startsWith('Too many open browsers')", WITHIN_S)
    live_page.unroute("**/events*")
    until(live_page, f"{BANNER} === ''", WITHIN_S)
    live_page.route("**/events*", lambda route: route.abort())
    live_page.reload()
    until(live_page, f"{BANNER}.startsWith('No data from the dashboard')", WITHIN_S)
