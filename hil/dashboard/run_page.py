"""Page of a run: controls of a live run, and results of an ended run.

The page of a live run shows the data of `LiveRun` and has forms for Stop, Pause, Resume and
answers. The forms for Stop, Pause and Resume work like `hil stop`: they write requests to the run
directory, which the process of the run reads.

The page of an ended run shows all readable facts, models and files of the run. A run that ended
early can be resumed on its page, in a new attempt that moves the arm. Resuming an ended run has a
separate address (`go-on`), so that a late click on the Resume button of a live run cannot move an
arm. The motion to be confirmed is shown before an ended run is resumed, as on the start page.
"""

from __future__ import annotations

import os
import secrets
import time
from asyncio import CancelledError
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.core import DataError, HilError, is_live, sha256_of, shell_word
from hil.dashboard.limits import in_thread
from hil.dashboard.live_runs import FIRST_LINES, LiveRun, question_words
from hil.dashboard.models import registered_models
from hil.dashboard.plan_preview import (
    MOTIONS,
    ClientGone,
    experiments_digest,
    plans_to_show,
    refusal_of,
)
from hil.dashboard.rendering import as_json, operator_of, page
from hil.dashboard.run_files import (
    folder_at,
    listed_files,
    report_address,
    require_run,
    run_address,
    run_name,
)
from hil.dashboard.security import form_of
from hil.dashboard.settings import Settings, settings_of
from hil.dashboard.start_page import Idempotency, require_text
from hil.estimators import MODEL_FILE, models_below
from hil.planning import load as load_experiment
from hil.planning import moves_for_real
from hil.recording import RunDirectory
from hil.report import (
    ENDINGS,
    PLURALS,
    RESUMABLE,
    Badge,
    Document,
    FitFacts,
    RunFacts,
    as_float,
    as_object,
    as_objects,
    badge_of,
    count,
    counted,
    criterion_text,
    duration,
    failed_fits,
    joint_title,
    measure,
    next_command,
    number,
    read_facts,
    sentence_of,
    verdict_words,
    when,
)
from hil.runs import ALWAYS_READ, stamp_of
from hil.workflow import (
    Reaction,
    answer_run,
    check_resume,
    go_on_with,
    pause_run,
    question_of,
    require_resumable,
    resume_live_run,
    started_runs,
    stop_run,
)


def run_page(request: Request) -> Response:
    """Show the page of a run, live or ended."""
    settings = settings_of(request)
    run = require_run(request.path_params["name"], settings)
    if not is_live(run):
        return ended_page(request, run)
    now = LiveRun(run, settings).look()
    now["log"] = now["log"][-FIRST_LINES:]
    try:
        virtual = _is_virtual(RunDirectory(run).start)
    except HilError:
        virtual = False
    return page(request, "live_run.html.j2", title=now["name"], now=now, virtual=virtual)


def _is_virtual(start: Document) -> bool:
    """Return whether a run uses simulated time, according to its start document."""
    return as_object(start.get("robot")).get("clock") == "virtual"


async def stop(request: Request) -> Response:
    """Stop a run now; also accept a page of an earlier dashboard process."""
    return await _ask(request, lambda run, who, form: stop_run(run, who=who, wait_s=0), old=True)


async def pause(request: Request) -> Response:
    """Pause a run at its next checkpoint."""
    return await _ask(request, lambda run, who, form: pause_run(run, who=who, wait_s=0))


async def resume(request: Request) -> Response:
    """Resume a paused run."""
    return await _ask(request, lambda run, who, form: resume_live_run(run, who=who, wait_s=0))


async def answer(request: Request) -> Response:
    """Answer the displayed question, but not a different one."""
    return await _ask(request, _answer)


def _answer(run: Path, who: str, form: dict[str, str]) -> Reaction:
    if form.get("answer") not in ("yes", "no"):
        raise DataError("the answer must be yes or no")
    question = question_of(run)
    shown = question_words(question.text)
    # Browsers use different line breaks, and an older run does not count its questions.
    same_text = shown.split() == form.get("prompt", "").split()
    same = form.get("asked", str(question.asked)) == str(question.asked)
    if not (same_text and same and form.get("attempt", question.holder) == question.holder):
        raise DataError(f"{run.name} now asks another question: {shown}", hint="read and answer it")
    return answer_run(run, form["answer"] == "yes", who=who, asked=question, wait_s=0)


async def _ask(
    request: Request,
    ask: Callable[[Path, str, dict[str, str]], Reaction],
    *,
    old: bool = False,
) -> Response:
    """Send a request to a live run; respond with its page or, for scripts, with JSON."""
    form, settings = await form_of(request, old=old), settings_of(request)

    def reaction() -> tuple[Reaction, str]:
        run, who = folder_at(request.path_params["name"], settings), operator_of(request)
        return _when_listening(lambda: ask(run, who, form), run), run_address(run, settings)

    def ended_at() -> str:
        run = folder_at(request.path_params["name"], settings)
        return "" if is_live(run) else run_address(run, settings)

    wants_page = "text/html" in request.headers.get("accept", "")
    try:
        reacted, address = await in_thread("control", reaction)
    except DataError:
        # Stop after the end of a run is not an error: its page shows how it ended.
        if old and wants_page and (ended := await in_thread("control", ended_at)):
            return RedirectResponse(ended, 303)
        raise
    if wants_page:
        return RedirectResponse(address, 303)
    return as_json(reacted.to_dict())


LISTENS_WITHIN_S = 3.0
"""Maximum time after the start of a run before the run accepts requests [s]."""


def _when_listening(ask: Callable[[], Reaction], run: Path) -> Reaction:
    """Send a request to a run; repeat the request while the run has just begun and rejects it."""
    deadline = time.monotonic() + LISTENS_WITHIN_S
    while True:
        try:
            return ask()
        except DataError as error:
            deaf = "does not accept requests" in error.message and is_live(run)
            if not deaf or time.monotonic() >= deadline:
                raise
        time.sleep(0.05)


RESUMPTIONS = Idempotency()


def ended_page(
    request: Request,
    run: Path,
    *,
    operator: str = "",
    shown: Mapping[str, Any] | None = None,
) -> Response:
    """Return the page of a run that is not live.

    Args:
        request: HTTP request to which the page responds.
        run: Path of the run directory, from `require_run`.
        operator: Operator of the resumption, as typed in the form.
        shown: Motion to be confirmed before the resumption (see `plans_to_show`), or the error that
            prevents the resumption.
    """
    settings, shown = settings_of(request), shown or {}
    facts = shown.get("facts", "")
    return page(
        request,
        "run.html.j2",
        title=run_name(run, settings),
        status=shown.get("status", 200),
        facts=facts_of_run(run, settings),
        onward=resume_offer(run, settings),
        address=run_address(run, settings),
        operator=operator,
        error=shown.get("error"),
        plans=shown.get("plans", []),
        checked=shown.get("checked", ""),
        motion=facts,
        confirms=MOTIONS.confirmed(facts).get("robot", ""),
    )


def resume_offer(run: Path, settings: Settings) -> dict[str, Any]:
    """Return the data that a page needs to offer the resumption of an ended run.

    Returns:
        The key `once` contains the token of a form that resumes the run; it is empty if the run
        cannot be resumed. The key `begun` contains the address of a process that is about to resume
        the run.
    """
    going = [one for one in started_runs(settings.runs) if one.alive and one.again == run]
    begun = (one.id for one in going if not one.made)  # others have resumed, and will exit
    if (name := next(begun, "")) or settings.read_only:
        return {"once": "", "begun": f"/start/{name}" if name else ""}
    try:
        resumable = require_resumable(run).status in RESUMABLE
    except Exception:  # a page is needed despite invalid files
        resumable = False
    return {"once": secrets.token_urlsafe(12) if resumable else "", "begun": ""}


async def go_on(request: Request) -> Response:
    """Resume an ended run in a new attempt; show the motion to be confirmed first."""
    fields, settings = await form_of(request), settings_of(request)
    operator = fields.get("operator", "").strip()[:80] or operator_of(request)

    def read() -> tuple[Path, str, bool]:
        require_text(operator, "the name of the operator")
        run = require_run(request.path_params["name"], settings)
        return run, *resumption_of(run, settings)

    def begin(confirmed: Mapping[str, Any] | None) -> str:
        def start() -> str:
            return go_on_with(run, settings.runs, operator=operator, confirmed=confirmed).id

        key = (str(run), fields.get("once", ""), operator)
        return RESUMPTIONS.result(key, start) if fields.get("once") else start()

    async def rest() -> dict[str, str]:
        return {"run": str(run)}

    run, digest, real = await in_thread("start", read)
    confirmed = (MOTIONS.confirmed(fields.get("facts", "")) or None) if real else None
    if (refusal := refusal_of(fields, digest, real=real)) is not None:
        try:
            shown = await plans_to_show(rest, request.is_disconnected)
        except (ClientGone, CancelledError):  # the client or the dashboard has gone
            return Response(status_code=499)
        # Without facts, the motion from the current pose was confirmed before, or none remains.
        if "error" in shown or shown["facts"]:
            shown = {"error": refusal, "status": 409} | shown
            return await run_in_threadpool(ended_page, request, run, operator=operator, shown=shown)
    return RedirectResponse(f"/start/{await in_thread('start', begin, confirmed)}", 303)


def resumption_of(run: Path, settings: Settings) -> tuple[str, bool]:
    """Return a digest of everything that a resumed run executes, and whether a real robot moves.

    Raises:
        HilError: The ended run cannot be resumed.
    """
    check_resume(run, settings.runs)
    experiment = load_experiment(run / "spec.yaml", run / "station.yaml")
    return experiments_digest([experiment]), moves_for_real(experiment)


def back_to_run(request: Request) -> Response:
    """Redirect to the page of the run if the form that `go_on` has shown is reloaded."""
    settings = settings_of(request)
    run = require_run(request.path_params["name"], settings)
    return RedirectResponse(run_address(run, settings), 303)


routes = [
    *(
        Route(f"/runs/{{name:place}}/{one.__name__}", one, methods=["POST"])
        for one in (stop, pause, resume, answer)
    ),
    Route("/runs/{name:place}/go-on", go_on, methods=["POST"]),
    Route("/runs/{name:place}/go-on", back_to_run),
    Route("/runs/{name:place}", run_page),
]


def facts_of_run(run: Path, settings: Settings) -> dict[str, Any]:
    """Return the `facts` that the page shows; for a damaged run, the readable part of the facts.

    Args:
        run: Path of the run directory, from `require_run`.
        settings: Settings of the dashboard.
    """
    files = {"files": listed_files(run, settings), "report": report_address(run, settings)}
    try:
        os.stat(os.path.join(run, "."))
    except OSError as error:
        text = f"The folder of the run cannot be opened: {error.strerror or error}"
        return {"unreadable": text, "name": run.name, **files}
    if not (run / "start.json").is_file() and not (run / "plan.json").is_file():
        text = "There is neither start.json nor plan.json: no run began here, or they were lost."
        return {"unreadable": text, "name": run.name, **files}
    try:
        return {**_facts(run, settings), **files}
    except Exception as error:  # the files can still be listed
        text = f"The run cannot be shown: {type(error).__name__}: {error}"
        return {"unreadable": text, "name": run.name, **files}


def _facts(run: Path, settings: Settings) -> dict[str, Any]:
    stamp = stamp_of(run)
    facts = read_facts(run) if stamp == ALWAYS_READ else _settled_facts(run, stamp)
    badge = badge_of(facts) if facts.whole else Badge(*ENDINGS["damaged"])
    problems = facts.stop.get("problems")
    warnings = [str(one) for one in problems] if isinstance(problems, list) else []
    return {
        "unreadable": "",
        "name": facts.name,
        "badge": {"text": badge.text.lower(), "mark": badge.mark or "quiet"},
        "sentence": sentence_of(facts),
        "virtual": _is_virtual(facts.start),
        "hint": str(facts.stop.get("hint") or ""),
        "command": next_command(facts, shell_word(run)),
        "warnings": [*facts.problems, *warnings, *failed_fits(facts), *facts.studies.warnings],
        "details": [(label, text) for label, text in _details(facts) if text],
        "complete": list(_completeness(facts)),
        "fits": [_fit(fit) for fit in facts.listed_fits],
        "criteria": [_criterion(row) for row in as_objects(facts.verdict.get("rows"))],
        "models": list(_models(run, settings)),
        "studies": [
            {"name": one.study, "title": one.title, "summary": one.summary}
            for one in facts.studies.made
        ],
    }


@lru_cache(maxsize=16)
def _settled_facts(run: Path, stamp: str) -> RunFacts:
    """Return the facts about an ended run; they are cached because counting recordings is slow."""
    return read_facts(run)


VIRTUAL = "virtual: simulated, no robot moved; all times are simulated"


def _details(facts: RunFacts) -> Iterator[tuple[str, str]]:
    """Yield pairs of a label and a text; the text is empty if the fact is unknown."""
    start, identity = facts.start, as_object(facts.robot.get("identity"))
    code = facts.stop.get("exit_code")
    yield "description", str(facts.spec.get("description") or "")
    yield "started", when(start.get("started"))
    yield "ended", when(facts.stop.get("stopped"))
    yield "robot", str(start.get("robot_name") or facts.path.parent.name)
    yield "clock", VIRTUAL if _is_virtual(facts.start) else ""
    yield "arm", str(facts.robot.get("model") or "")
    yield "serial number", str(identity.get("serial") or "")
    yield "operator", str(start.get("operator") or "")
    yield "part of the program", facts.commissioning
    yield "loads", ", ".join(_load(load) for load in as_objects(start.get("loads")))
    yield "occasion", str(start.get("occasion") or "")
    yield "program", _program(facts)
    yield "recorded", _recorded(facts)
    yield "verdict", verdict_words(facts)
    yield "reason of the end", str(facts.stop.get("reason") or "")
    yield "exit code", "" if code is None else str(code)


def _load(load: Document) -> str:
    mass = as_float(load.get("mass_kg"))
    return " ".join(filter(None, (str(load.get("name") or ""), f"{number(mass)} kg")))


def _program(facts: RunFacts) -> str:
    if not facts.steps:
        return ""
    kinds = [str(step.get("kind")) for step in facts.steps]
    counts = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}
    steps = ", ".join(
        f"{n} {kind if n == 1 else PLURALS.get(kind, f'{kind}s')}" for kind, n in counts.items()
    )
    ended = f"; ended in {facts.ended_in}" if facts.ended_in else ""
    return f"{counted(len(kinds), 'step')}: {steps}{ended}"


def _recorded(facts: RunFacts) -> str:
    recorded = facts.recorded
    if "samples" not in recorded:
        return ""
    took = duration(as_float(recorded.get("device_s")))
    gaps = counted(recorded.get("gaps", 0), "gap")
    missing = f"{recorded.get('missing', 0)} missing in {gaps}"
    samples = recorded["samples"]
    shown = count(samples) if isinstance(samples, int) else samples
    return f"{shown} sample{'' if samples == 1 else 's'} in {took}; {missing}"


def _completeness(facts: RunFacts) -> Iterator[dict[str, Any]]:
    """Yield the measured share of each part of the program."""
    for kind, counts in as_object(facts.recorded.get("complete")).items():
        done, of = (as_float(as_object(counts).get(key)) for key in ("done", "of"))
        if of > 0 and done >= 0:
            yield {"kind": kind, "done": int(done), "of": int(of)}


def _fit(fit: FitFacts) -> dict[str, Any]:
    columns = [fit.values(metric) for metric in ("rmse_raw", "rmse_filtered", "nrmse")]
    columns.append(fit.values("rmse_raw", "trained"))
    means = [fit.mean(metric) for metric in ("rmse_raw", "rmse_filtered", "nrmse")]
    means.append(fit.mean("rmse_raw", "trained"))
    joints = [
        {"name": joint_title(j, name), "values": [number(column[j]) for column in columns]}
        for j, name in enumerate(fit.joint_names)
    ]
    return {
        "label": fit.label,
        "unit": fit.unit,
        "note": "" if fit.is_honest else f"Not judged: {fit.protocol}.",
        "joints": [*joints, {"name": "mean", "values": [number(mean) for mean in means]}],
    }


def _criterion(row: Document) -> dict[str, Any]:
    return {
        "what": str(row.get("estimator") or "recording"),
        "limit": criterion_text(row),
        "of": str(row.get("what") or ""),
        "found": measure(row.get("value"), row.get("unit")),
        "passed": bool(row.get("passed")),
    }


def _models(run: Path, settings: Settings) -> Iterator[dict[str, Any]]:
    """Yield the model folders of a run, each with the registered versions of the model."""
    folders = models_below(run)
    known = registered_models(settings) if folders else {}
    for folder in folders:
        try:
            digest = sha256_of(folder / MODEL_FILE)
        except OSError:
            digest = ""
        yield {"name": folder.relative_to(run).as_posix(), "versions": known.get(digest, [])}
