"""Going on with a run that ended early, from its page: the arm moves, in a new attempt."""

from __future__ import annotations

import secrets
from asyncio import CancelledError
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.dashboard.checked import digest_of
from hil.dashboard.motions import MOTIONS, plans_to_show, refusal_of
from hil.dashboard.once import Once
from hil.dashboard.places import address_of, name_of
from hil.dashboard.planning import Gone
from hil.dashboard.rendering import page, settings_of, who_of
from hil.dashboard.run_facts import facts_of_run
from hil.dashboard.run_files import require_run
from hil.dashboard.security import form_of
from hil.dashboard.settings import Settings
from hil.dashboard.threads import in_thread
from hil.dashboard.wanted import require_text
from hil.planning import load as load_experiment
from hil.planning import moves_for_real
from hil.report import RESUMABLE
from hil.workflow import check_resume, go_on_with, require_resumable, started_runs

ONCE = Once()


def way_on(run: Path, settings: Settings) -> dict[str, Any]:
    """What the page of a run that is not live offers.

    Returns:
        `once` for the form where it can be gone on with, else an empty text; `begun`, the address
        of a process that is about to go on with it.
    """
    going = [one for one in started_runs(settings.runs) if one.alive and one.again == run]
    begun = (one.id for one in going if not one.made)  # else it has gone on, and only closes
    if (name := next(begun, "")) or settings.read_only:
        return {"once": "", "begun": f"/start/{name}" if name else ""}
    try:
        offered = require_resumable(run).status in RESUMABLE
    except Exception:  # whatever its files say: its page is there
        offered = False
    return {"once": secrets.token_urlsafe(12) if offered else "", "begun": ""}


def ended_page(
    request: Request,
    run: Path,
    *,
    operator: str = "",
    shown: Mapping[str, Any] | None = None,
) -> Response:
    """Return the page of a run that is not live.

    Args:
        request: What is answered.
        run: Its directory.
        operator: Who goes on with it, as typed.
        shown: What has to be confirmed before it goes on, see `plans_to_show`; or why it does not.
    """
    settings, shown = settings_of(request), shown or {}
    facts = shown.get("facts", "")
    return page(
        request,
        "run.html.j2",
        title=name_of(run, settings),
        status=shown.get("status", 200),
        facts=facts_of_run(run, settings),
        onward=way_on(run, settings),
        address=address_of(run, settings),
        operator=operator,
        error=shown.get("error"),
        plans=shown.get("plans", []),
        checked=shown.get("checked", ""),
        motion=facts,
        confirms=MOTIONS.confirmed(facts).get("robot", ""),
    )


async def go_on(request: Request) -> Response:
    """Start a new attempt of a run; show first what has to be confirmed.

    Not what Resume of a live run asks for: pressed a moment too late, that must move no arm.
    """
    given, settings = await form_of(request), settings_of(request)
    operator = given.get("operator", "").strip()[:80] or who_of(request)

    def look() -> tuple[Path, str, bool]:
        require_text(operator, "the name of who is at the robot")
        run = require_run(request.path_params["name"], settings)
        return run, *resumption_of(run, settings)

    def begin(confirmed: Mapping[str, Any] | None) -> str:
        start = partial(go_on_with, run, settings.runs, operator=operator, confirmed=confirmed)
        sent = (str(run), given.get("once", ""), operator)
        return ONCE.of(sent, lambda: start().id) if given.get("once") else start().id

    run, digest, real = await in_thread("starting", look)
    confirmed = (MOTIONS.confirmed(given.get("facts", "")) or None) if real else None
    if (refusal := refusal_of(given, digest, real=real)) is not None:
        try:
            shown = await plans_to_show(lambda: _asked(run), request.is_disconnected)
        except (Gone, CancelledError):  # by the client, or with the dashboard: it is not read
            return Response(status_code=499)
        # Without facts the motion was confirmed before, from where the arm stands, or none is left.
        if "error" in shown or shown["facts"]:
            shown = {"error": refusal, "status": 409} | shown
            return await run_in_threadpool(ended_page, request, run, operator=operator, shown=shown)
    return RedirectResponse(f"/start/{await in_thread('starting', begin, confirmed)}", 303)


def resumption_of(run: Path, settings: Settings) -> tuple[str, bool]:
    """Return a digest of what going on with a run executes, and whether a real robot moves.

    Raises:
        HilError: It cannot be gone on with.
    """
    check_resume(run, settings.runs)
    experiment = load_experiment(run / "spec.yaml", run / "station.yaml")
    return digest_of([experiment]), moves_for_real(experiment)


async def _asked(run: Path) -> dict[str, str]:
    return {"run": str(run)}


def back_to_run(request: Request) -> Response:
    """Lead to the page of the run: the address is that of a form which was shown again."""
    settings = settings_of(request)
    run = require_run(request.path_params["name"], settings)
    return RedirectResponse(address_of(run, settings), 303)


routes = [
    Route("/runs/{name:place}/go-on", go_on, methods=["POST"]),
    Route("/runs/{name:place}/go-on", back_to_run),
]
