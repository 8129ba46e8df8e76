"""The page of a run, its live part, and what is asked of it: stop, pause, resume, answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.core import DataError, is_live
from hil.dashboard.live_facts import FIRST_LINES, LiveRun, question_words
from hil.dashboard.places import address_of, run_at
from hil.dashboard.rendering import as_json, page, settings_of, who_of
from hil.dashboard.resume_pages import ended_page
from hil.dashboard.run_details import is_virtual
from hil.dashboard.run_files import require_run
from hil.dashboard.security import form_of
from hil.dashboard.streams import events, run_events
from hil.dashboard.threads import in_thread
from hil.workflow import Reaction, answer_run, pause_run, question_of, resume_live_run, stop_run

LISTENS_WITHIN_S = 3.0
"""A run that has just begun hears nothing for a moment."""


def run_page(request: Request) -> Response:
    """A run: as it goes on, or what came of it."""
    settings = settings_of(request)
    run = require_run(request.path_params["name"], settings)
    if not is_live(run):
        return ended_page(request, run)
    now = LiveRun(run, settings).look()
    now["log"] = now["log"][-FIRST_LINES:]
    return page(request, "live_run.html.j2", title=now["name"], now=now, virtual=is_virtual(run))


async def stop(request: Request) -> Response:
    """Stop a run now."""
    return await _asked(request, lambda run, who, form: stop_run(run, who=who, wait_s=0), old=True)


async def pause(request: Request) -> Response:
    """Pause a run at its next checkpoint."""
    return await _asked(request, lambda run, who, form: pause_run(run, who=who, wait_s=0))


async def resume(request: Request) -> Response:
    """Let a paused run go on."""
    return await _asked(request, lambda run, who, form: resume_live_run(run, who=who, wait_s=0))


async def answer(request: Request) -> Response:
    """Answer the question that was shown, and no other one."""
    return await _asked(request, _answered)


def _answered(run: Path, who: str, form: dict[str, str]) -> Reaction:
    if form.get("answer") not in ("yes", "no"):
        raise DataError("an answer is yes or no")
    question = question_of(run)
    shown = question_words(question.text)
    # Browsers end lines in their own way, and an older run does not count its questions.
    same_text = shown.split() == form.get("prompt", "").split()
    same = form.get("asked", str(question.asked)) == str(question.asked)
    if not (same_text and same and form.get("attempt", question.holder) == question.holder):
        raise DataError(f"{run.name} asks something else now: {shown}", hint="read it and answer")
    return answer_run(run, form["answer"] == "yes", who=who, asked=question, wait_s=0)


async def _asked(
    request: Request,
    ask: Callable[[Path, str, dict[str, str]], Reaction],
    *,
    old: bool = False,
) -> Response:
    form, settings = await form_of(request, old=old), settings_of(request)

    def reaction() -> tuple[Reaction, str]:
        run, who = run_at(request.path_params["name"], settings), who_of(request)
        return _heard(lambda: ask(run, who, form), run), address_of(run, settings)

    def ended_at() -> str:
        run = run_at(request.path_params["name"], settings)
        return "" if is_live(run) else address_of(run, settings)

    page_wanted = "text/html" in request.headers.get("accept", "")
    try:
        reacted, address = await in_thread("asking", reaction)
    except DataError:
        if old and page_wanted and (ended := await in_thread("asking", ended_at)):
            return RedirectResponse(ended, 303)  # whoever stops what has ended wants to see that
        raise
    if page_wanted:
        return RedirectResponse(address, 303)
    return as_json(reacted.to_dict())


def _heard(ask: Callable[[], Reaction], run: Path) -> Reaction:
    """Ask a run that need not listen yet; what it does then is seen in its events."""
    deadline = time.monotonic() + LISTENS_WITHIN_S
    while True:
        try:
            return ask()
        except DataError as error:
            deaf = "does not listen" in error.message and is_live(run)
            if not deaf or time.monotonic() >= deadline:
                raise
        time.sleep(0.05)


routes = [
    Route("/events", events),
    Route("/runs/{name:place}/events", run_events),
    *(
        Route(f"/runs/{{name:place}}/{one.__name__}", one, methods=["POST"])
        for one in (stop, pause, resume, answer)
    ),
    Route("/runs/{name:place}", run_page),
]
