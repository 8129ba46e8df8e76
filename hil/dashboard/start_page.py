"""The start page: its form, the check and the start of what it asks for, and starts without a run.

A form goes through three steps. `read_start_form` refuses what cannot be started before anything is
planned; it hands out a `StartRequest`. With `do=check` the plan is shown (`plan_preview`), and its
digests go into the form. With `do=start` the run is started, if it is still what was checked and a
real robot's motion was confirmed. `Idempotency` sees to it that a form which is sent twice, by a
double click or a reload, starts one run.

An operator who may start runs may not thereby read this computer. Specs and stations are named from
the list of `offered_files`, below the folder of `hil serve --specs`. Files that overrides name must
lie there as well (`require_offered_files`): what a reader of poses cannot use, it quotes.
"""

from __future__ import annotations

import os
import re
import secrets
import threading
import time
import unicodedata
from asyncio import CancelledError
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.core import DataError, HilError, SpecError, name_read, name_text, scalar, shown
from hil.dashboard.limits import in_thread
from hil.dashboard.live_runs import pending_words
from hil.dashboard.plan_preview import (
    MOTIONS,
    ClientGone,
    experiments_digest,
    plans_to_show,
    refusal_of,
)
from hil.dashboard.rendering import operator_of, page
from hil.dashboard.run_files import run_address, run_name
from hil.dashboard.security import form_of
from hil.dashboard.settings import Settings, settings_of
from hil.planning import commissioning_of, moves_for_real
from hil.workflow import Started, check_start, start_run, started_runs

FIELDS = ("spec", "station", "overrides", "operator", "speed", "first")
"""Fields that decide what is started."""

SPEEDS = ("50%", "25%", "10%", "5%")

MOST_STARTS = 5
"""Starts that the page lists, the newest."""


def start_page(request: Request) -> Response:
    """Show the form, empty or with the spec that the address names."""
    return _form(request, {"spec": request.query_params.get("spec", "")})


def _form(
    request: Request,
    fields: Mapping[str, str],
    *,
    error: HilError | None = None,
    plans: list[dict[str, Any]] | None = None,
    checked: str = "",
    facts: str = "",
    status: int = 200,
) -> Response:
    settings = settings_of(request)
    return page(
        request,
        "start.html.j2",
        title="Start a run",
        status=status,
        specs=offered_files(settings, "experiment", "series"),
        stations=offered_files(settings, "station"),
        folder=settings.specs and settings.specs.resolve(),
        given={key: fields.get(key, "") for key in FIELDS},
        speeds=SPEEDS,
        error=error,
        once=secrets.token_urlsafe(12),
        plans=plans or [],
        checked=checked,
        facts=facts,
        confirms=MOTIONS.confirmed(facts).get("robot", ""),
        started=[_row(one, settings) for one in started_runs(settings.runs)[:MOST_STARTS]],
    )


def _row(started: Started, settings: Settings) -> dict[str, Any]:
    runs = started.made
    resumed = started.again is not None
    if runs:
        text = "goes on" if resumed else "has begun"
    elif started.alive:
        text = pending_words(started)
    else:
        text = "did not go on" if resumed else "did not begin"
    return {
        "id": started.id,
        "spec": name_text(Path(started.spec).name),
        "operator": started.operator,
        "alive": started.alive,
        "text": text,
        "log": started.log,
        "run": run_address(started.again, settings) if started.again else "",
        "address": run_address(runs[-1], settings) if runs else f"/start/{started.id}",
    }


async def check_or_start(request: Request) -> Response:
    """Check what the form asks for and show the plan, or start it."""
    fields, settings = await form_of(request), settings_of(request)

    async def form(**more: Any) -> Response:
        return await run_in_threadpool(_form, request, fields, **more)

    read = partial(read_start_form, fields, settings, operator_of(request))
    refused: dict[str, Any] = {}
    try:
        if fields.get("do") == "start":
            asked = await run_in_threadpool(read)
            refusal = refusal_of(fields, asked.digest, real=asked.real)
            if refusal is None:
                started = await in_thread("start", _start, asked, fields, settings)
                return RedirectResponse(f"/start/{started}", 303)
            refused = {"error": refusal, "status": 409}
        plans = await plans_to_show(
            lambda: run_in_threadpool(lambda: read().plan_request), request.is_disconnected
        )
    except HilError as error:
        return await form(error=error, status=422)
    except (ClientGone, CancelledError):  # the client, or the dashboard, has gone: it is not read
        return Response(status_code=499)
    return await form(**refused | plans)


def _start(asked: StartRequest, fields: Mapping[str, str], settings: Settings) -> str:
    """Start it, and return the id of the start."""

    def start() -> str:
        return start_run(
            asked.spec, settings.runs, station=asked.station, operator=asked.operator,
            overrides=asked.overrides, speed=asked.speed, first=asked.first,
            confirmed=MOTIONS.confirmed(fields.get("facts", "")) if asked.real else None,
        ).id  # fmt: skip

    if not fields.get("once"):
        return start()
    # With its fields: a form that was changed and sent again is another one, although going back
    # keeps its hidden token.
    key = (str(settings.runs), fields["once"], *(fields.get(name, "") for name in FIELDS))
    return STARTS.result(key, start)


def started_page(request: Request) -> Response:
    """Show a start that has no run yet, or never got one; else lead to the page of its run."""
    settings = settings_of(request)
    started = _started(request.path_params["id"], settings)
    if made := started.made:
        return RedirectResponse(run_address(made[-1], settings), 303)
    last_words = started.last_words
    return page(
        request,
        "started.html.j2",
        title="Starting" if started.alive else "Not started",
        started=_row(started, settings),
        last_words=last_words,
        held=None if started.alive else lock_owner(last_words, settings),
    )


def _started(name: str, settings: Settings) -> Started:
    for one in started_runs(settings.runs):
        if one.id == name:
            return one
    raise DataError(f"nothing was started as {name}", hint="see /start")


_HELD = re.compile(
    r"RobotConnectionError: robot (.+?) is held by pid .*, run (.+)\)(?:, still after .*)?"
)
"""Message of `hil.robot.lease.leased` about a holder that has a run."""


def lock_owner(last_words: Sequence[str], settings: Settings) -> dict[str, str] | None:
    """Return `robot`, `name` and `address` of the run that holds the robot a start did not get.

    Args:
        last_words: Lines with which the start ended.
        settings: What is served.

    Returns:
        None if no line names a run that is served here.
    """
    for line in last_words:
        if (match := _HELD.fullmatch(line.strip())) is None:
            continue
        run = Path(match[2])
        try:
            if run.is_dir():
                address, name = run_address(run, settings), run_name(run, settings)
                return {"robot": match[1], "name": name, "address": address}
        except (ValueError, OSError):  # in another folder of runs; no path at all
            continue
    return None


async def cancel(request: Request) -> Response:
    """End a start that has no run yet."""
    await form_of(request)
    name, settings = request.path_params["id"], settings_of(request)
    await in_thread("control", lambda: _started(name, settings).cancel(operator_of(request)))
    return RedirectResponse(f"/start/{name}", 303)


routes = [
    Route("/start", start_page),
    Route("/start", check_or_start, methods=["POST"]),
    Route("/start/{id}", started_page),
    Route("/start/{id}/cancel", cancel, methods=["POST"]),
]


KEPT_S = 600.0

MOST_KEPT = 1000
"""Results kept at the same time; the oldest are forgotten first."""


class Idempotency:
    """Results of forms, kept for some minutes: one that is sent twice acts once.

    Safe from any thread.

    Args:
        kept_s: How long results are kept [s].
    """

    def __init__(self, kept_s: float = KEPT_S) -> None:
        self._kept_s = kept_s
        self._lock = threading.Lock()
        self._results: dict[Hashable, tuple[float, Future[str]]] = {}

    def result(self, key: Hashable, act: Callable[[], str]) -> str:
        """Return what `act` returned when this key came first; one that raised is called again.

        Args:
            key: Identity of the form and of its fields.
            act: Called unless it was, or is being, called for this key. Others with the same key
                wait for its result, and nothing else does.
        """
        mine: Future[str] = Future()
        with self._lock:
            self._forget()
            _, first = self._results.setdefault(key, (time.monotonic(), mine))
        if first is mine:
            try:
                mine.set_result(act())
            except BaseException as error:  # also to those that wait
                with self._lock:
                    self._results.pop(key, None)
                mine.set_exception(error)
        return first.result()

    def _forget(self) -> None:
        until = time.monotonic() - self._kept_s
        old = [key for key, (when, _) in self._results.items() if when < until]
        for key in old or list(self._results)[: -MOST_KEPT + 1]:
            del self._results[key]


STARTS = Idempotency()


@dataclass(frozen=True, slots=True)
class StartRequest:
    """What a form asks for, as it would be started now.

    Attributes:
        digest: See `hil.dashboard.plan_preview.experiments_digest`.
        real: Whether a real robot would move; its motion has to be confirmed.
    """

    spec: Path
    station: Path | None
    overrides: dict[str, str]
    operator: str
    speed: str
    first: str
    digest: str
    real: bool

    @property
    def plan_request(self) -> dict[str, Any]:
        """What has to be planned, see `hil.dashboard.plan_preview.plan_in_process`."""
        return {
            "spec": str(self.spec),
            "station": str(self.station or ""),
            "overrides": self.overrides,
            "speed": self.speed,
            "first": self.first,
        }


def read_start_form(fields: Mapping[str, str], settings: Settings, operator: str) -> StartRequest:
    """Return what a form asks for, before anything is planned or started.

    Args:
        fields: Fields of the form.
        settings: Says which files are offered.
        operator: The one at the browser, if the form names none.

    Raises:
        HilError: It cannot be started.
    """
    spec = offered_file(fields.get("spec", ""), settings, "experiment", "series")
    station_name = fields.get("station", "")
    station = offered_file(station_name, settings, "station") if station_name else None
    overrides = read_overrides(fields.get("overrides", ""))
    require_offered_files(overrides, spec, settings)
    operator = fields.get("operator", "").strip()[:80] or operator
    require_text(operator, "the name of who is at the robot")
    speed, first = fields.get("speed", "").strip(), fields.get("first", "").strip()
    experiments = check_start(spec, station, overrides, commissioning_of(speed, first))
    digest = experiments_digest(experiments, speed, first)
    real = any(map(moves_for_real, experiments))
    return StartRequest(spec, station, overrides, operator, speed, first, digest, real)


def read_overrides(text: str) -> dict[str, str]:
    """Return values by dotted path, of lines `path=value`; empty lines are skipped.

    Raises:
        SpecError: A line is no such pair, or has control characters.
    """
    require_text(text, "what is laid over the spec", but="\r\n\t")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    pairs = [line.partition("=") for line in lines]
    for line, (path, equals, _) in zip(lines, pairs, strict=True):
        if not (equals and path.strip()):
            raise SpecError(f"{line!r} changes nothing", hint="a line is: excitation.waypoints=20")
    return {path.strip(): value.strip() for path, _, value in pairs}


def require_text(text: str, what: str, *, but: str = "") -> None:
    """Refuse control characters: no command line takes a NUL, and no name or value needs one.

    Args:
        text: What was typed, or sent by a program.
        what: Name of the text, for the message.
        but: Control characters that are allowed.

    Raises:
        SpecError: It has others.
    """
    found = sorted({c for c in text if unicodedata.category(c) == "Cc" and c not in but})
    if found:
        listed = ", ".join(f"U+{ord(c):04X}" for c in found)
        raise SpecError(f"{what} has control characters ({listed})", hint="type it anew")


LOOKED_AT = 2000
"""Files below the folder, which may be somebody's home."""

MOST_SPEC_BYTES = 1_000_000


def offered_files(settings: Settings, *kinds: str) -> list[str]:
    """Return the names of the files of some kinds (`experiment`, `series`, `station`).

    Relative to the folder, as text that a form can hold (`hil.core.text.name_text`).
    """
    if settings.specs is None:
        return []
    found = islice(_files(settings.specs), LOOKED_AT)
    return sorted(
        name_text(path.relative_to(settings.specs)) for path in found if _kind_in(path) in kinds
    )


def offered_file(name: str, settings: Settings, *kinds: str) -> Path:
    """Return the file of a name.

    Raises:
        SpecError: No file of that name and of these kinds is offered.
    """
    if settings.specs is None or name not in offered_files(settings, *kinds):
        raise SpecError(
            f"{name!r} is not offered here", hint=f"offered is what {settings.specs} has"
        )
    return settings.specs / name_read(name)


def _files(folder: Path) -> list[Path]:
    found = []
    for above, folders, names in os.walk(folder):
        if "start.json" in names:  # a run: its spec.yaml is what it was run with
            folders.clear()
            continue
        folders[:] = sorted(one for one in folders if not one.startswith("."))
        found += [Path(above) / name for name in sorted(names) if name.endswith((".yaml", ".yml"))]
        if len(found) >= LOOKED_AT:
            break
    return found


def _kind_in(path: Path) -> str:
    try:
        about = path.stat()
    except OSError:
        return ""
    return _kind(path, about.st_mtime_ns) if about.st_size < MOST_SPEC_BYTES else ""


_KIND = re.compile(rb"^(hil|hil_series|hil_station)\s*:", re.MULTILINE)
_WORDS = {b"hil": "experiment", b"hil_series": "series", b"hil_station": "station"}


@lru_cache(maxsize=LOOKED_AT)
def _kind(path: Path, changed: int) -> str:
    """Return the kind that a file says it is of; read once per change."""
    try:
        found = _KIND.search(path.read_bytes())
    except OSError:
        return ""
    return _WORDS[found[1]] if found else ""


FILE_KEYS = ("file",)
"""Keys of a spec whose values are files (a test looks for others)."""

PROSE = ("description", "prompt", "name")
"""Keys whose values are never opened as files."""

MOST_POSE_FILE_BYTES = 20_000_000
"""As many poses as a program may have fit into that."""


def require_offered_files(overrides: Mapping[str, str], spec: Path, settings: Settings) -> None:
    """Refuse values that name files outside of the offered folder, symbolic links followed.

    Parameters of plug-ins may be files under any key, so every text that is a path is looked at.
    The message does not reveal whether a file outside exists.

    Args:
        overrides: YAML text by dotted path, as a browser sent it.
        spec: Spec they are laid over; relative paths start at its folder.
        settings: Says what is offered.

    Raises:
        SpecError: A value is no YAML, or names a file elsewhere or one that is too long.
    """
    for place, text in overrides.items():
        for path, value in _texts(scalar(text, shown(place)), (*place.split("."),)):
            if path[-1] in PROSE or not (path[-1] in FILE_KEYS or "/" in value or "\\" in value):
                continue
            if not _is_offered(spec.parent, value, settings):
                raise SpecError(
                    f"{shown('.'.join(path))} names {shown(value)}, which is not in the folder "
                    "that is offered here",
                    hint=f"put the file into {settings.specs}, or write it into the spec there",
                )
            if path[-1] in FILE_KEYS and _bytes_of(spec.parent / value) > MOST_POSE_FILE_BYTES:
                raise SpecError(
                    f"{shown('.'.join(path))} names {shown(value)}, which is too long to be read "
                    f"here: more than {MOST_POSE_FILE_BYTES // 10**6} MB",
                    hint="is it the right file? or start it on the command line: `hil run`",
                )


def _texts(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield every text in a value, with its path; an entry of a list has the path of the list."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _texts(inner, (*path, str(key)))
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner, path)


def _is_offered(folder: Path, name: str, settings: Settings) -> bool:
    if settings.specs is None:
        return False
    try:
        return (folder / name).resolve().is_relative_to(settings.specs.resolve())
    except (OSError, ValueError, RuntimeError):  # no file system takes it, or a loop of links
        return False


def _bytes_of(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:  # its reader raises an error that says so
        return 0
