"""Going on with a run that ended early, from its page: the arm moves, in a new attempt."""

from __future__ import annotations

import secrets
from functools import partial
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.campaign.resuming import require_resumable
from hil.campaign.starting import go_on_with, started_runs
from hil.report.judgement import RESUMABLE
from hil.web.once import Once
from hil.web.rendering import settings_of, who_of
from hil.web.run_files import require_run
from hil.web.security import form_of
from hil.web.settings import Settings
from hil.web.threads import in_thread
from hil.web.wanted import require_text

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


async def go_on(request: Request) -> Response:
    """Start a new attempt of a run.

    Not what Resume of a live run asks for: pressed a moment too late, that must move no arm.
    """
    given, settings = await form_of(request), settings_of(request)
    operator = given.get("operator", "").strip()[:80] or who_of(request)

    def begun() -> str:
        require_text(operator, "the name of who is at the robot")
        run = require_run(request.path_params["name"], settings)
        start = partial(go_on_with, run, settings.runs, operator=operator)
        sent = (str(run), given.get("once", ""), operator)
        return ONCE.of(sent, lambda: start().id) if given.get("once") else start().id

    return RedirectResponse(f"/start/{await in_thread('starting', begun)}", 303)


routes = [Route("/runs/{name:place}/go-on", go_on, methods=["POST"])]
