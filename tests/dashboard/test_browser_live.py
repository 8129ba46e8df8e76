"""Live runs in a browser when things are not well: many pages, a hung dashboard, a hung run."""

from __future__ import annotations

import contextlib
import json
import platform
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
from tests.support.browser.bench import opened, served
from tests.support.browser.looking import until
from tests.support.live_run import live_run
from tests.support.waiting import until as wait

pytestmark = [pytest.mark.wire, pytest.mark.timeout(120)]

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
def browser() -> Iterator[Any]:
    with opened() as one:
        yield one


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str, Any]]:
    """A folder, the address of its dashboard and that dashboard's process."""
    folder = tmp_path_factory.mktemp("live")
    with served(folder) as (address, process):
        yield folder, address, process


@pytest.fixture
def page(browser: Any, bench: Bench) -> Iterator[Any]:
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


def text_of(page: Any, selector: str) -> str:
    return str(page.evaluate("(s) => document.querySelector(s).textContent", selector))


def test_ten_pages_of_a_run_are_kept_up_to_date_and_stop_acts_in_the_last(
    page: Any, bench: Bench
) -> None:
    with live_run(bench[0] / "runs") as (run, _):
        pages = [page, *(page.context.new_page() for _ in range(PAGES - 1))]
        for one in pages:
            one.goto(address_of(run, bench))
        shown = pages[-1].evaluate(SAMPLES)
        for one in pages:
            assert one.evaluate("document.visibilityState") == "visible"
            until(one, f"{SAMPLES} > {shown}", WITHIN_S)
        pages[0].close()  # it held the stream for all
        begun = time.monotonic()
        pages[-1].click(".stopping button.stop")
        wait(lambda: outcome(run), WITHIN_S)
        assert time.monotonic() - begun < 2.0
        for one in pages[1:]:
            until(
                one, "document.getElementById('standing').textContent.includes('stopped')", WITHIN_S
            )


def test_a_hung_dashboard_is_said_and_stop_is_asked_for_again(page: Any, bench: Bench) -> None:
    folder, _, process = bench
    with live_run(folder / "runs") as (run, _):
        page.goto(address_of(run, bench))
        page.wait_for_timeout(500)
        assert page.evaluate(BANNER) == ""
        process.send_signal(signal.SIGSTOP)
        until(page, f"{BANNER}.startsWith('No news from the dashboard for ')", OLD_WITHIN_S)
        assert page.evaluate("document.body.classList.contains('old')")
        process.send_signal(signal.SIGCONT)
        until(page, f"{BANNER} === ''", WITHIN_S)

        process.send_signal(signal.SIGSTOP)
        # Of a page that is being left the driver tells nothing; its console it does.
        page.evaluate(TELLS)
        with page.expect_console_message(lambda told: "been taken" in told.text) as refused:
            page.evaluate("document.querySelector('.stopping button.stop').click()")
            assert text_of(page, ".stopping .said") == "stopping …"
        assert "“Stop” may not have been taken: no answer" in refused.value.text
        assert "robot’s own button" in refused.value.text
        with page.expect_navigation(timeout=20_000):  # asked once more, as without scripts
            process.send_signal(signal.SIGCONT)
        wait(lambda: outcome(run) == "stopped", WITHIN_S)


def test_a_refusal_is_said_at_the_button_and_a_refused_stream_is_asked_for_again(
    page: Any, bench: Bench
) -> None:
    with live_run(bench[0] / "runs") as (run, _):
        page.route("**/events*", partial(refuse, 500))
        page.goto(address_of(run, bench))
        until(page, f"{BANNER} !== ''", WITHIN_S)
        page.unroute("**/events*")
        until(page, f"{BANNER} === ''", WITHIN_S)
        for status in (401, 403, 500):
            page.route("**/stop", partial(refuse, status))
            page.click("main button.stop")
            refused = f"was NOT taken: {status}"
            told = "document.querySelector('main .stop ~ .refused').textContent"
            until(page, f"{told}.includes('{refused}')", WITHIN_S)
            page.unroute("**/stop")
        page.click("main button.stop")
        wait(lambda: outcome(run) == "stopped", WITHIN_S)


def test_a_hung_run_is_told_apart_in_the_header_and_on_the_overview(
    page: Any, bench: Bench
) -> None:
    with live_run(bench[0] / "runs") as (_, process):
        page.goto(bench[1])
        page.wait_for_selector(".stopping")
        assert page.locator(".silent").count() == 0
        process.send_signal(signal.SIGSTOP)
        for where in (".stopping", ".card"):
            page.wait_for_selector(f"{where} .silent", timeout=20_000)
            assert "no news for " in page.inner_text(f"{where} .silent")
        assert page.evaluate(BANNER) == ""  # the dashboard itself is well
        process.send_signal(signal.SIGCONT)
        until(page, "!document.querySelector('.silent')", WITHIN_S)


def test_a_question_takes_no_answer_before_anybody_can_have_read_it(
    page: Any, bench: Bench
) -> None:
    posted = []
    page.on("request", lambda one: posted.append(one.url) if one.method == "POST" else None)
    press = f"document.querySelector('{QUESTION}').click()"
    with live_run(bench[0] / "runs", "Mount the weight", "twice") as (run, _):
        # By the page's own clock: the driver may be late.
        page.add_init_script(
            "addEventListener('DOMContentLoaded', () => setTimeout(() => {"
            f" window.free = {FREE}; {press}; }}, 300))"
        )
        page.goto(address_of(run, bench))
        until(page, "'free' in window", WITHIN_S)
        assert page.evaluate("window.free") is False
        until(page, FREE, WITHIN_S)
        page.focus(QUESTION)
        page.evaluate(f"{press}; {press}; {press}")
        first = page.evaluate("document.querySelector('[name=asked]').value")
        changed = f"document.querySelector('[name=asked]').value !== '{first}'"
        page.evaluate(
            f"() => {{ const looking = setInterval(() => {{ if (!({changed})) return;"
            f" clearInterval(looking); setTimeout(() => {{ {press}; window.late = true; }}, 300);"
            " }, 5); }"
        )
        until(page, "window.late", WITHIN_S)
        assert page.evaluate("document.activeElement.matches('button[value=yes]')")
        until(page, FREE, WITHIN_S)
        assert len(posted) == 1
        page.evaluate(press)
        page.wait_for_selector(".question", state="hidden")
        assert len(posted) == 2


def test_pause_and_resume_follow_the_run_and_the_keyboard_stays_where_it_is(
    page: Any, bench: Bench
) -> None:
    def free(what: str) -> str:
        return f"document.querySelector('[data-can={what}]').ariaDisabled !== 'true'"

    with live_run(bench[0] / "runs") as (run, _):
        page.goto(address_of(run, bench))
        until(page, f"{free('pause')} && !({free('resume')})", WITHIN_S)
        page.focus("[data-can=pause]")
        page.keyboard.press("Enter")
        until(page, f"!({free('pause')}) && {free('resume')}", WITHIN_S)
        assert page.evaluate("document.activeElement.dataset.can") == "pause"
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.dataset.can") == "resume"
        page.keyboard.press("Enter")
        until(page, f"{free('pause')} && !({free('resume')})", WITHIN_S)
        assert page.evaluate("document.activeElement.dataset.can") == "resume"
        page.keyboard.press("Enter")  # nothing is asked
        page.wait_for_timeout(200)
        assert text_of(page, "[data-can=resume] ~ .said") == ""


def test_what_is_being_planned_comes_and_goes_in_the_header_of_every_page(
    page: Any, bench: Bench
) -> None:
    folder, address, _ = bench
    page.goto(f"{address}models")
    with being_planned(folder, "1", "2"):
        until(page, "document.querySelector('#live .planned .how')", WITHIN_S)
        told = " ".join(text_of(page, "#live .planned").split())
        name = "asks_for_a_rather_long_while.yaml"
        assert told == f"{name} is being planned Cancel {name}"
        page.set_viewport_size({"width": 390, "height": 800})
        box = page.locator("#live .planned").first.bounding_box()
        assert box["width"] > 340, "one below the other on a phone"
        assert box["height"] < 80
        page.focus("#live .planned button")
    until(page, "!document.querySelector('#live .planned')", WITHIN_S)
    assert page.evaluate("document.activeElement.id") == "main"


def test_the_keyboard_stays_at_cancel_while_a_run_is_planned(page: Any, bench: Bench) -> None:
    folder, address, _ = bench
    with being_planned(folder, "17") as planning:
        log = folder / "runs" / ".started" / "17.log"
        log.write_text("reads the spec\n")
        page.goto(f"{address}start/17")
        page.evaluate("window.same = true")
        page.focus("main button.stop")
        log.write_text("reads the spec\nplans\n")
        until(page, "document.getElementById('printed').textContent.includes('plans')", WITHIN_S)
        assert page.evaluate("window.same && document.activeElement.matches('main button.stop')")
        planning.kill()
        planning.wait()
        page.wait_for_selector("text=did not begin")
        assert page.locator("main button.stop").count() == 0
        assert "plans" in page.inner_text("#printed")


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


def test_too_many_pages_are_told_apart_from_a_dashboard_that_is_gone(
    page: Any, bench: Bench
) -> None:
    page.route("**/events*", partial(refuse, 503))
    page.goto(bench[1])
    until(page, f"{BANNER}.startsWith('Too many browsers listen')", WITHIN_S)
    page.unroute("**/events*")
    until(page, f"{BANNER} === ''", WITHIN_S)
    page.route("**/events*", lambda route: route.abort())
    page.reload()
    until(page, f"{BANNER}.startsWith('No news from the dashboard')", WITHIN_S)
