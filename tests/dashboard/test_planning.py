"""A plan for the start page is a process of its own, which ends: in time, and with others."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from html import unescape
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import urlopen

import pytest

from hil.core.errors import PlanError
from hil.dashboard import plan_preview
from hil.workflow.background_runs import ticks_of
from tests.support.started_parts import written
from tests.support.waiting import until
from tests.support.web_parts import dashboard, failing

ENDLESS = "excitation.waypoints=100000"
ASKED = {"spec": "", "station": "", "overrides": {}, "speed": "", "first": ""}


async def stays() -> bool:
    return False


async def leaves() -> bool:
    return True


@pytest.fixture
def plans_as(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Plan by another program: the text of a module, which may note its process in `pid`."""

    def so(text: str) -> Path:
        note = f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid()))"
        (tmp_path / "planned_so.py").write_text(f"import os, sys, time\n{note}\n{text}")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        monkeypatch.setattr(plan_preview, "MODULE", "planned_so")
        return tmp_path / "pid"

    return so


def check(folder: Path) -> tuple[int, str]:
    (folder / "specs").mkdir()
    written(folder / "specs")
    desk = dashboard(folder)
    csrf = desk.app.state.settings.csrf  # type: ignore[attr-defined]
    answer = desk.post("/start", data={"csrf": csrf, "spec": "asks.yaml", "do": "check"})
    return answer.status_code, unescape(re.sub("<[^>]+>", " ", answer.text))


@pytest.mark.thorough
def test_modules_in_the_working_folder_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / "mark"
    (tmp_path / "numpy.py").write_text(f"open({str(mark)!r}, 'w')")
    monkeypatch.chdir(tmp_path)
    status, text = check(tmp_path)
    assert status == 200, text
    assert not mark.exists()


@pytest.mark.thorough
def test_a_plan_that_takes_too_long_is_ended_and_said(
    tmp_path: Path, plans_as: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_preview, "LIMIT_S", 1.0)
    pid = plans_as("time.sleep(60)")
    status, text = check(tmp_path)
    assert status == 422
    assert "this plan takes longer than 1 s" in text
    assert "plan it with `hil plan`" in text
    assert not ticks_of(int(pid.read_text()))


@pytest.mark.thorough
def test_a_plan_has_so_much_memory_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_preview, "MOST_BYTES", 150 * 1024**2)
    status, text = check(tmp_path)
    assert status == 422
    assert "no plan" in text
    assert "a plan may take 0.15 GB here" in text


def test_arrays_that_do_not_fit_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_preview, "_plan", failing(MemoryError()))
    assert plan_preview._answer(ASKED) == {"error": plan_preview.TOO_LARGE, "broken": True}


@pytest.mark.parametrize("text", ["os._exit(7)", "print('no JSON')", "print('[')", "print('7')"])
def test_a_planning_that_breaks_is_said(plans_as: Any, text: str) -> None:
    plans_as(text)
    with pytest.raises(PlanError, match="ended without an answer"):
        asyncio.run(plan_preview.plan_in_process(ASKED, stays))


def test_nobody_waits_and_nothing_is_planned(plans_as: Any) -> None:
    pid = plans_as("time.sleep(60)")

    async def gone() -> bool:
        return pid.exists() and bool(pid.read_text())

    with pytest.raises(plan_preview.ClientGone):
        asyncio.run(plan_preview.plan_in_process(ASKED, gone))
    assert not ticks_of(int(pid.read_text()))


def test_a_request_that_is_ended_ends_its_plan(plans_as: Any) -> None:
    pid = plans_as("import subprocess\nsubprocess.run(['sleep', '60'])")

    async def ended() -> None:
        task = asyncio.create_task(plan_preview.plan_in_process(ASKED, stays))
        while not (pid.exists() and pid.read_text() and children_of(int(pid.read_text()))):
            await asyncio.sleep(0.02)
        inner.extend(children_of(int(pid.read_text())))
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    inner: list[int] = []
    asyncio.run(ended())
    until(lambda: not any(map(ticks_of, [int(pid.read_text()), *inner])))


def test_the_token_is_not_handed_on(plans_as: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HIL_TOKEN", "k" * 16)
    plans_as("import json; print(json.dumps({'plans': [], 'env': dict(os.environ)}))")
    answer = asyncio.run(plan_preview.plan_in_process(ASKED, stays))
    assert "HIL_TOKEN" not in answer["env"]


@pytest.mark.thorough
def test_a_plan_ends_with_whoever_asked_for_it(tmp_path: Path) -> None:
    spec, _ = written(tmp_path)
    asked = {**ASKED, "spec": str(spec), "overrides": dict([ENDLESS.split("=")]), "bytes": 2**32}
    with subprocess.Popen(
        [sys.executable, "-m", "hil.dashboard.plan_preview"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps(asked).encode() + b"\n")
            process.stdin.flush()
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(1)
            process.stdin.close()
            assert process.wait(10) == -signal.SIGKILL
        finally:
            process.kill()


@pytest.mark.wire
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_dashboard_ends_while_it_plans(tmp_path: Path, number: int) -> None:
    written(tmp_path)
    with subprocess.Popen(
        [sys.executable, "-m", "hil", "serve", "--port", "0", "--specs", "."],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[-1]
            (csrf,) = set(re.findall(r'name="csrf" value="([^"]+)"', opened(f"{address}start")))
            form = {"csrf": csrf, "spec": "asks.yaml", "do": "check", "overrides": ENDLESS}
            asking = threading.Thread(target=opened, args=(f"{address}start", form), daemon=True)
            asking.start()
            until(lambda: children_of(process.pid), 20)
            (child,) = children_of(process.pid)
            time.sleep(0.5)
            process.send_signal(number)
            begun = time.monotonic()
            assert process.wait(20) == 130
            assert time.monotonic() - begun < 6
            until(lambda: not ticks_of(child))
        finally:
            process.kill()


STUCK = """
import sys, time
from pathlib import Path
from starlette.routing import Route
from hil.dashboard import server
from hil.dashboard.server import create_app
from hil.dashboard.settings import Settings

def stuck(request):
    print("here", flush=True)
    time.sleep(60)

def made(settings):
    app = create_app(settings)
    app.router.routes.insert(0, Route("/stuck", stuck))
    return app

server.create_app = made
settings = Settings(Path("runs"), Path("registry"))
server.serve(settings, server.listen("127.0.0.1", 0), lambda told: print(told, flush=True))
"""


@pytest.mark.wire
def test_the_dashboard_ends_though_a_page_never_answers(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", f"import signal\n{HANDLED}\n{STUCK}"],
        cwd=tmp_path, stdout=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            threading.Thread(target=opened, args=(f"{address}stuck",), daemon=True).start()
            assert process.stdout.readline() == "here\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == 130
        finally:
            process.kill()


HANDLED = "signal.signal(signal.SIGTERM, signal.default_int_handler)"
"""As the command line does."""


def opened(address: str, form: dict[str, str] | None = None) -> str:
    try:
        with urlopen(address, urlencode(form).encode() if form else None, timeout=30) as answer:
            return str(answer.read().decode())
    except (URLError, OSError):
        return ""


def children_of(pid: int) -> list[int]:
    try:
        return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
