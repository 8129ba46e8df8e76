"""Start page: form, check and start of a run, and pages of starts that have no run yet.

A start form is processed in three steps. First, `read_start_form` rejects requests that cannot be
started, before anything is planned; valid requests are returned as a `StartRequest`. If the form
contains `do=check`, the plan is shown (`plan_preview`), and its digests are added to the form. If
the form contains `do=start`, the run is started, provided that it is identical to the checked run
and that the motion of a real robot was confirmed. `Idempotency` ensures that a form that is sent
two times, by a double click or a reload, starts only one run.

The permission to start runs does not include the permission to read files of this computer. Specs
and stations are selected from the list of `offered_files`, all of which are below the folder of
`hil serve --specs`. Files named in overrides must also be in this folder (`require_offered_files`),
because errors about files of poses quote invalid lines.
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
"""Names of the form fields that determine what is started."""

SPEEDS = ("50%", "25%", "10%", "5%")

MOST_STARTS = 5
"""Number of newest starts that the page lists."""


def start_page(request: Request) -> Response:
    """Show the start form, empty or with the spec that the address names."""
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
        text = "has resumed" if resumed else "has started"
    elif started.alive:
        text = pending_words(started)
    else:
        text = "did not resume" if resumed else "did not start"
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
    """Check the request of the form and show its plan, or start it."""
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
    except (ClientGone, CancelledError):  # no client reads the answer
        return Response(status_code=499)
    return await form(**refused | plans)


def _start(asked: StartRequest, fields: Mapping[str, str], settings: Settings) -> str:
    """Start a run and return the identifier of this start."""

    def start() -> str:
        return start_run(
            asked.spec, settings.runs, station=asked.station, operator=asked.operator,
            overrides=asked.overrides, speed=asked.speed, first=asked.first,
            confirmed=MOTIONS.confirmed(fields.get("facts", "")) if asked.real else None,
        ).id  # fmt: skip

    if not fields.get("once"):
        return start()
    # The key includes the fields: a form that was changed and sent again is a new request, although
    # the browser's back button retains its hidden token.
    key = (str(settings.runs), fields["once"], *(fields.get(name, "") for name in FIELDS))
    return STARTS.result(key, start)


def started_page(request: Request) -> Response:
    """Show a start that has no run, or redirect to the page of its run."""
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
    raise DataError(f"there is no start {name}", hint="see /start")


_HELD = re.compile(
    r"RobotConnectionError: robot (.+?) is held by pid .*, run (.+)\)(?:, still after .*)?"
)
"""Pattern of the message of `hil.robot.lease.leased` if the lease belongs to a run."""


def lock_owner(last_words: Sequence[str], settings: Settings) -> dict[str, str] | None:
    """Return `robot`, `name` and `address` of the run that has leased the robot of a failed start.

    Args:
        last_words: Last lines of the output of the failed start.
        settings: Settings of the dashboard.

    Returns:
        None if no output line names a run of this dashboard.
    """
    for line in last_words:
        if (match := _HELD.fullmatch(line.strip())) is None:
            continue
        run = Path(match[2])
        try:
            if run.is_dir():
                address, name = run_address(run, settings), run_name(run, settings)
                return {"robot": match[1], "name": name, "address": address}
        except (ValueError, OSError):  # in a different folder of runs, or not a valid path
            continue
    return None


async def cancel(request: Request) -> Response:
    """Cancel a start that has no run yet."""
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
"""Maximum number of stored results; the oldest results are removed first."""


class Idempotency:
    """Results of forms, stored for some minutes, so that a form that is sent two times acts once.

    The class `Idempotency` is thread-safe.

    Args:
        kept_s: Time for which the results of forms are stored [s].
    """

    def __init__(self, kept_s: float = KEPT_S) -> None:
        self._kept_s = kept_s
        self._lock = threading.Lock()
        self._results: dict[Hashable, tuple[float, Future[str]]] = {}

    def result(self, key: Hashable, act: Callable[[], str]) -> str:
        """Return the result of the first call of `act` with a key; call `act` again after an error.

        Args:
            key: Identity of the form and of the values of its fields.
            act: Function that is called, unless it has been called or is being called for this key.
                Other calls with the same key wait for the result; calls with other keys do not
                wait.
        """
        mine: Future[str] = Future()
        with self._lock:
            self._forget()
            _, first = self._results.setdefault(key, (time.monotonic(), mine))
        if first is mine:
            try:
                mine.set_result(act())
            except BaseException as error:  # the calls that wait must get the error as well
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
    """Checked request of a start form, in the form in which it would be started now.

    Attributes:
        digest: Digest of the experiments, from `hil.dashboard.plan_preview.experiments_digest`.
        real: Whether a real robot would move, so that its motion must be confirmed.
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
        """Request for a plan, in the form that `plan_preview.plan_in_process` accepts."""
        return {
            "spec": str(self.spec),
            "station": str(self.station or ""),
            "overrides": self.overrides,
            "speed": self.speed,
            "first": self.first,
        }


def read_start_form(fields: Mapping[str, str], settings: Settings, operator: str) -> StartRequest:
    """Return the request in a start form, before anything is planned or started.

    Args:
        fields: Fields of the start form.
        settings: Settings of the dashboard, which define the offered files.
        operator: Name of the operator at the browser, used if the form contains no operator.

    Raises:
        HilError: The request in the form cannot be started.
    """
    spec = offered_file(fields.get("spec", ""), settings, "experiment", "series")
    station_name = fields.get("station", "")
    station = offered_file(station_name, settings, "station") if station_name else None
    overrides = read_overrides(fields.get("overrides", ""))
    require_offered_files(overrides, spec, settings)
    operator = fields.get("operator", "").strip()[:80] or operator
    require_text(operator, "the name of the operator")
    speed, first = fields.get("speed", "").strip(), fields.get("first", "").strip()
    experiments = check_start(spec, station, overrides, commissioning_of(speed, first))
    digest = experiments_digest(experiments, speed, first)
    real = any(map(moves_for_real, experiments))
    return StartRequest(spec, station, overrides, operator, speed, first, digest, real)


def read_overrides(text: str) -> dict[str, str]:
    """Return overrides by dotted path from lines of the form `path=value`; skip empty lines.

    Raises:
        SpecError: A line does not have the form `path=value`, or contains control characters.
    """
    require_text(text, "an override", but="\r\n\t")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    pairs = [line.partition("=") for line in lines]
    for line, (path, equals, _) in zip(lines, pairs, strict=True):
        if not (equals and path.strip()):
            raise SpecError(
                f"{line!r} is not an override",
                hint="write one override per line: excitation.waypoints=20",
            )
    return {path.strip(): value.strip() for path, _, value in pairs}


def require_text(text: str, what: str, *, but: str = "") -> None:
    """Raise if a text contains control characters, which no command line, name or value needs.

    Args:
        text: Text from a user or from a program.
        what: Name of the text in the error message.
        but: Control characters that the text may contain.

    Raises:
        SpecError: The text contains control characters that are not allowed.
    """
    found = sorted({c for c in text if unicodedata.category(c) == "Cc" and c not in but})
    if found:
        listed = ", ".join(f"U+{ord(c):04X}" for c in found)
        raise SpecError(f"{what} has control characters ({listed})", hint="type it again")


LOOKED_AT = 2000
"""Maximum number of files below the folder of specs that are inspected; the folder is possibly a
home folder.
"""

MOST_SPEC_BYTES = 1_000_000


def offered_files(settings: Settings, *kinds: str) -> list[str]:
    """Return the names of the offered files of some kinds (`experiment`, `series`, `station`).

    The names are relative to the folder of specs and are encoded for a form
    (`hil.core.text.name_text`).
    """
    if settings.specs is None:
        return []
    found = islice(_files(settings.specs), LOOKED_AT)
    return sorted(
        name_text(path.relative_to(settings.specs)) for path in found if _kind_in(path) in kinds
    )


def offered_file(name: str, settings: Settings, *kinds: str) -> Path:
    """Return the path of the offered file with a name.

    Raises:
        SpecError: No file with this name and of one of these kinds is offered.
    """
    if settings.specs is None or name not in offered_files(settings, *kinds):
        raise SpecError(
            f"{name!r} is not offered here", hint=f"offered are the files in {settings.specs}"
        )
    return settings.specs / name_read(name)


def _files(folder: Path) -> list[Path]:
    found = []
    for above, folders, names in os.walk(folder):
        if "start.json" in names:  # a run directory: its spec.yaml is a copy
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
    """Return the kind that a file declares; the kind is cached until the file changes."""
    try:
        found = _KIND.search(path.read_bytes())
    except OSError:
        return ""
    return _WORDS[found[1]] if found else ""


FILE_KEYS = ("file",)
"""Keys of a spec whose values are file names; a test detects missing keys."""

PROSE = ("description", "prompt", "name")
"""Keys of a spec whose values are never opened as files."""

MOST_POSE_FILE_BYTES = 20_000_000
"""Maximum size of a file of poses, sufficient for the maximum number of poses in a program."""


def require_offered_files(overrides: Mapping[str, str], spec: Path, settings: Settings) -> None:
    """Raise if a value names a file outside the offered folder, after following links.

    Parameters of plug-ins can be files under any key; therefore, every text that is a path is
    checked. The error message does not reveal whether a file outside the folder exists.

    Args:
        overrides: Values as YAML text by dotted path, as sent by a browser.
        spec: Path of the spec to which the overrides apply; relative paths are relative to the
            folder of the spec.
        settings: Settings of the dashboard, which define the offered folder.

    Raises:
        SpecError: A value is not valid YAML, names a file outside the folder, or names a file that
            is too large.
    """
    for place, text in overrides.items():
        for path, value in _texts(scalar(text, shown(place)), (*place.split("."),)):
            if path[-1] in PROSE or not (path[-1] in FILE_KEYS or "/" in value or "\\" in value):
                continue
            if not _is_offered(spec.parent, value, settings):
                raise SpecError(
                    f"{shown('.'.join(path))} names {shown(value)}, which is not in the folder "
                    "of specs",
                    hint=f"copy the file to {settings.specs}, or name it in a spec there",
                )
            if path[-1] in FILE_KEYS and _bytes_of(spec.parent / value) > MOST_POSE_FILE_BYTES:
                raise SpecError(
                    f"{shown('.'.join(path))} names {shown(value)}, which is too large here: more "
                    f"than {MOST_POSE_FILE_BYTES // 10**6} MB",
                    hint="check the file, or start it on the command line: `hil run`",
                )


def _texts(value: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield every text in a nested value with its path; entries of a list have its path."""
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
    except (OSError, ValueError, RuntimeError):  # an invalid path, or a loop of links
        return False


def _bytes_of(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:  # the reader of the file raises the error
        return 0
