"""Pages of schedules: due occasions, results of earlier occasions, hold and release.

`Schedule` is a schedule that this dashboard knows: the schedule has a state folder with a ledger,
or its file is one of the offered files. The file and the ledger of a schedule are read separately,
so that one of the two can be shown if the other is damaged. This module does not run schedules;
hold and release append an entry to the ledger of a schedule.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from itertools import islice, takewhile
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from hil.core import (
    LOCK,
    MOST_BYTES,
    DataError,
    HilError,
    SpecError,
    did_you_mean,
    duration_text,
    holder_of,
    quoted,
    read_source,
    shell_word,
)
from hil.dashboard.rendering import operator_of, page
from hil.dashboard.run_files import run_link
from hil.dashboard.security import form_of
from hil.dashboard.settings import Settings, settings_of
from hil.maintenance import (
    LEDGER_FILE,
    Expected,
    Ledger,
    Line,
    Motions,
    clock_problem,
    forecast,
    hold,
    occasion_of,
    occasions,
    release,
)
from hil.recording import folders_in
from hil.spec import KEY, Blackout, ScheduleSpec, Trigger, load_schedule_spec

PER_PAGE = 50
LISTED_EVENTS = ("started", "done", "failed", "missed", "held", "released")
LONGEST_REASON = 500


def schedules(request: Request) -> Response:
    """Show the list of all schedules and their next due occasions."""
    settings = settings_of(request)
    rows = [list_row(one) for one in known_schedules(settings)]
    return page(request, "schedules.html.j2", title="Schedules", schedules=rows)


def schedule(request: Request) -> Response:
    """Show one schedule."""
    settings = settings_of(request)
    one = _schedule_named(request.path_params["name"], settings)
    lines = one.ledger.lines if one.ledger else []
    lines = [line for line in lines if line["event"] in LISTED_EVENTS]
    pages = max(1, math.ceil(len(lines) / PER_PAGE))
    asked = request.query_params.get("page", "1")
    at = min(max(int(asked) if asked.isdecimal() and len(asked) < 9 else 1, 1), pages)
    shown = lines[::-1][(at - 1) * PER_PAGE : at * PER_PAGE]
    expected, unforeseen = forecast_of(one)
    return page(
        request, "schedule.html.j2", title=one.name, one=list_row(one), problems=one.problems,
        held=one.held, by_hand=bool(one.ledger and one.ledger.standing.held),
        facts=file_facts(one), blackouts=blackouts_of(one.spec),
        expected=[forecast_row(each, one) for each in expected], unforeseen=unforeseen,
        open=open_text(one), lines=[history_row(line, one, settings) for line in shown],
        count=len(lines), at=at, pages=pages, address=one.address,
        commands=commands_for(one, settings),
    )  # fmt: skip


async def hold_schedule(request: Request) -> Response:
    """Hold a schedule: nothing begins until it is released."""
    return await _set_hold(request, hold)


async def release_schedule(request: Request) -> Response:
    """Release a held schedule."""
    return await _set_hold(request, release)


async def _set_hold(
    request: Request, act: Callable[[Ledger, datetime, str, str], Line]
) -> Response:
    reason = " ".join((await form_of(request)).get("reason", "").split())[:LONGEST_REASON]
    if not reason:
        raise SpecError("a reason is required", hint="go back and enter one for the ledger")

    def append() -> Response:
        one = _schedule_named(request.path_params["name"], settings_of(request))
        if one.ledger is None:
            raise DataError(one.problems[0])
        if not one.ledger.lines:
            raise DataError(
                f"{one.name} has never been started", hint="start it with: hil schedule run FILE"
            )
        act(one.ledger, datetime.now(UTC), reason, operator_of(request))
        return RedirectResponse(one.address, 303)

    return await run_in_threadpool(append)


def _schedule_named(name: str, settings: Settings) -> Schedule:
    known = {one.name: one for one in known_schedules(settings)}
    if name not in known:
        hint = did_you_mean(name, known) or "see /schedules"
        raise DataError(f"there is no schedule {name}", hint=hint)
    return known[name]


routes = [
    Route("/schedules", schedules),
    Route("/schedules/{name}", schedule),
    Route("/schedules/{name}/hold", hold_schedule, methods=["POST"]),
    Route("/schedules/{name}/release", release_schedule, methods=["POST"]),
]

DEEPEST = 4
LOOKED_AT = 2000
"""Maximum number of files below the folder of specs that are inspected; the folder is possibly a
home folder.
"""

COMING = 8
AHEAD = timedelta(days=28)
_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")


@dataclass(frozen=True, slots=True)
class Schedule:
    """Schedule with a state folder on this computer or with an offered file.

    Attributes:
        name: Name of the schedule.
        folder: Path of the state folder, which possibly does not exist yet.
        file: Path of the file of the schedule; None if the file is not one of the offered files.
        spec: Content of the file of the schedule; None if the file cannot be read.
        ledger: Ledger of the schedule, empty before the first start of the schedule; None if
            damaged.
        problems: Messages about errors in the file and in the ledger.
    """

    name: str
    folder: Path
    file: Path | None
    spec: ScheduleSpec | None
    ledger: Ledger | None
    problems: tuple[str, ...]

    @property
    def address(self) -> str:
        """Path of the dashboard page of the schedule."""
        return f"/schedules/{quoted(self.name)}"

    @property
    def zone(self) -> ZoneInfo:
        """Time zone in which the schedule is defined."""
        return ZoneInfo(self.spec.timezone if self.spec else "UTC")

    @property
    def held(self) -> str:
        """Reason why the schedule is held, so that no job begins; empty if it is not held."""
        if self.ledger is None:
            return "its ledger cannot be read"
        standing = self.ledger.standing
        if standing.held is not None:
            return str(standing.held.get("why") or "no reason was given")
        return clock_problem(standing, datetime.now(UTC))

    @property
    def run_by(self) -> str:
        """Text that names the process that runs the schedule; empty if no process runs it."""
        holder = holder_of(self.folder / LOCK) if self.folder.is_dir() else None
        return holder.told(self.zone) if holder else ""

    def due(self, most: int) -> list[tuple[datetime, str]]:
        """Return the next unsettled occasions, as pairs of due time (UTC) and job."""
        if self.spec is None or self.ledger is None:
            return []
        now, standing = datetime.now(UTC), self.ledger.standing
        after = max(now, standing.until or now)
        found = occasions(self.spec, standing.anchor or now, after)
        near = takewhile(lambda one: one.due <= now + AHEAD, found)
        return [(one.due, one.job) for one in islice(near, most)]


def known_schedules(settings: Settings) -> list[Schedule]:
    """Return all schedules with a state folder or with an offered file, sorted by name."""
    files = _files_by_name(settings.specs)
    states = [path for path in folders_in(settings.schedules) if (path / LEDGER_FILE).is_file()]
    names = {path.name for path in states} | set(files)
    return [_read_schedule(name, settings, files.get(name)) for name in sorted(names)]


def due_next(settings: Settings) -> list[dict[str, Any]]:
    """Return the next due occasions of all started schedules, earliest first.

    Returns:
        The data of an occasion are `name`, `address`, `job` (`probe` or `campaign`), `due` (UTC),
        `when` (text in the time zone of the schedule), `held` (reason why the job will not be done;
        empty if the schedule is not held) and `run_by` (process that would do the job; empty if no
        process runs the schedule).
    """
    found: list[dict[str, Any]] = []
    for one in known_schedules(settings):
        if one.ledger is None or not one.ledger.lines:
            continue
        common = {"name": one.name, "address": one.address, "held": one.held, "run_by": one.run_by}
        found += [
            {
                **common,
                "due": due,
                "when": f"{moment_words(due, one.zone)} ({one.zone})",
                "job": job,
            }
            for due, job in one.due(COMING)
        ]
    return sorted(found, key=lambda each: each["due"])[:COMING]


def moment_words(moment: datetime, zone: ZoneInfo) -> str:
    """Return a time as text in a time zone, such as `Sat 28 Nov 2026, 03:00`."""
    return f"{moment.astimezone(zone):%a %d %b %Y, %H:%M}"


def _read_schedule(name: str, settings: Settings, file: Path | None) -> Schedule:
    folder, problems = settings.schedules / name, list[str]()
    spec = ledger = None
    try:
        ledger = Ledger.read(folder)
        if ledger.lines:
            ledger.require_of(name)
    except HilError as error:
        problems.append(error.message)
    try:
        spec = load_schedule_spec(file) if file else None
    except HilError as error:
        problems.append(error.message)
    return Schedule(name, folder, file, spec, ledger, tuple(problems))


def _files_by_name(specs: Path | None) -> dict[str, Path]:
    """Return the schedule files below a folder, by the name of the schedule."""
    if specs is None:
        return {}
    found: dict[str, Path] = {}
    for entry in islice(_files_below(specs), LOOKED_AT):
        if entry.name.endswith((".yaml", ".yml")) and (name := _name_in(entry)):
            found.setdefault(name, Path(entry))
    return found


def _name_in(entry: os.DirEntry[str]) -> str:
    stat = entry.stat()
    if stat.st_size >= MOST_BYTES:  # larger than any valid spec
        return ""
    return _name_of(Path(entry), stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=LOOKED_AT)
def _name_of(path: Path, changed: int, size: int) -> str:
    """Return the name of the schedule in a file; empty if the file does not contain a schedule.

    The name is cached until the file changes.
    """
    try:
        if KEY.encode() not in path.read_bytes():
            return ""
        data = read_source(path).data
    except (OSError, HilError):
        return path.stem
    if not isinstance(data, dict) or KEY not in data:
        return ""
    name = str(data.get("name"))
    return name if _PLAIN.fullmatch(name) else path.stem


def _files_below(folder: Path, depth: int = 0) -> Iterator[os.DirEntry[str]]:
    """Yield the files in a folder first, then the files in its subfolders."""
    try:
        with os.scandir(folder) as entries:
            found = sorted(entries, key=lambda entry: entry.name)
    except OSError:
        return
    found = [entry for entry in found if not entry.name.startswith(".")]
    yield from (entry for entry in found if entry.is_file())
    if depth < DEEPEST:
        for entry in found:
            if entry.is_dir(follow_symlinks=False):
                yield from _files_below(Path(entry), depth + 1)


FORESEEN = 12
MOST_MISSED = 3000
"""Maximum number of unsettled past occasions for which a page shows a forecast."""

MARKS = {"done": "pass", "failed": "fail", "missed": "warn", "held": "warn"}


def list_row(one: Schedule) -> dict[str, Any]:
    """Return the row of a schedule in the list of schedules."""
    begun = bool(one.ledger and one.ledger.lines)
    due, lines = one.due(1), one.ledger.lines if one.ledger else []
    last = next((line for line in reversed(lines) if line["event"] in MARKS), None)
    return {
        "name": one.name,
        "address": one.address,
        "description": one.spec.description if one.spec else "",
        "begun": begun,
        "held": one.held if begun or one.ledger is None else "",
        "run_by": one.run_by,
        "next": f"{due[0][1]}, {moment_words(due[0][0], one.zone)} ({one.zone})" if due else "",
        "last": _summary(last) if last else "",
        "last_event": str(last["event"]) if last else "",
        "last_mark": MARKS.get(str(last["event"]), "quiet") if last else "",
        "damaged": bool(one.problems),
        "zone": str(one.zone),
    }


def _summary(line: Line) -> str:
    result = line.get("result")
    if isinstance(result, dict):
        return f"{result.get('outcome', '')}: {result.get('text', '')}"
    return str(line.get("why") or "")


def forecast_of(one: Schedule) -> tuple[list[Expected], str]:
    """Return the expected occasions from now on, or the reason why there are none."""
    if one.ledger is None:
        return [], "There is no forecast: the ledger is damaged."
    if one.spec is None:
        return [], "There is no forecast: the file is damaged, or not in the folder of specs."
    now, standing = datetime.now(UTC), one.ledger.standing
    if standing.until and standing.anchor:
        missed = occasions(one.spec, standing.anchor, standing.until)
        past = takewhile(lambda each: each.due <= now, missed)
        if sum(1 for _ in islice(past, MOST_MISSED)) >= MOST_MISSED:
            return [], "Too many occasions were missed for a forecast here: use hil schedule plan."
    due = one.due(FORESEEN)
    end = due[-1][0] + timedelta(seconds=1) if due else now + timedelta(seconds=1)
    try:
        return forecast(one.spec, one.ledger, Motions(), now, end), ""
    except HilError as error:
        return [], error.message


def forecast_row(each: Expected, one: Schedule) -> dict[str, Any]:
    """Return a row of the table of expected occasions."""
    late = each.begins and each.begins > each.due + timedelta(seconds=59)
    return {
        "due": moment_words(each.due, one.zone),
        "job": each.job + (f" and {each.count - 1} more" if each.count > 1 else ""),
        "missed": each.begins is None,
        "begins": moment_words(each.begins, one.zone) if each.begins and late else "",
        "why": "resumed" if each.again and not each.why else each.why,
    }


def open_text(one: Schedule) -> str:
    """Return a text about the open occasion, which has begun or is waiting."""
    standing = one.ledger.standing if one.ledger else None
    if standing is None or standing.open is None:
        return ""
    what = f"{standing.open.job} due {moment_words(standing.open.due, one.zone)}"
    return f"{what}: begun" if standing.begun else f"{what}: waits, {standing.why or 'not begun'}"


def history_row(line: Line, one: Schedule, settings: Settings) -> dict[str, Any]:
    """Return a row of the table of earlier occasions."""
    result = line.get("result")
    runs = result.get("runs") if isinstance(result, dict) else None
    count = line.get("count")
    return {
        "at": moment_words(datetime.fromisoformat(line["at"]), one.zone),
        "event": line["event"],
        "mark": MARKS.get(line["event"], "quiet"),
        "occasion": _occasion(line, one),
        "more": count - 1 if isinstance(count, int) and count > 1 else 0,
        "what": _summary(line),
        "by": str(line.get("by") or ""),
        "runs": [
            {"stage": stage, **run_link(str(folder), settings)}
            for stage, folder in (runs.items() if isinstance(runs, dict) else ())
        ],
    }


def _occasion(line: Line, one: Schedule) -> str:
    try:
        occasion = occasion_of(str(line.get("occasion", "")))
    except ValueError:
        return ""
    return f"{occasion.job}, {moment_words(occasion.due, one.zone)}"


def file_facts(one: Schedule) -> list[tuple[str, str]]:
    """Return the facts about the file of a schedule, as pairs of label and text."""
    spec = one.spec
    if spec is None:
        return [("state", str(one.folder))]
    found = [
        ("file", str(one.file)),
        ("probe", _trigger(spec.probe, spec.probe.spec) if spec.probe else "none"),
        ("campaign", _trigger(spec.campaign, spec.campaign.spec)),
        ("after a change", "the campaign follows" if spec.campaign.on_drift else ""),
        ("models", spec.model or "models of the campaign's robot"),
        ("missed occasions", _missed(spec)),
        ("state", str(one.folder)),
    ]
    return [(label, text) for label, text in found if text]


def _trigger(trigger: Trigger, spec: str) -> str:
    when = duration_text(trigger.every) if trigger.every else trigger.cron
    every = "every " if trigger.every else ""
    return f"{spec.rpartition('/')[2]}: {f'{every}{when}' if when else 'only after a change'}"


def _missed(spec: ScheduleSpec) -> str:
    within = duration_text(spec.missed_within)
    return f"done within {within}" if spec.missed == "run" else "skipped"


def blackouts_of(spec: ScheduleSpec | None) -> list[dict[str, str]]:
    """Return the table rows about the blackout times of a schedule."""
    return [_blackout(one) for one in spec.blackout] if spec else []


def _blackout(one: Blackout) -> dict[str, str]:
    first, last = (str(day) if day else "" for day in (one.first, one.last))
    span = f"from {first} " * bool(first) + f"until {last}" * bool(last)
    return {
        "days": ", ".join(one.days) or "every day",
        "hours": f"{one.begin} to {one.end}",
        "season": span.strip() or "always",
        "why": one.why,
    }


def commands_for(one: Schedule, settings: Settings) -> list[tuple[str, str]]:
    """Return suitable terminal commands, as pairs of a description and a command."""
    file = shell_word(one.file or "FILE")
    state = f"--state {shell_word(one.folder)}"
    where = f"--registry {shell_word(settings.registry)}"
    runs = f"--runs {shell_word(settings.runs)}"
    return [
        ("Execute all occasions when due:", f"hil schedule run {file} {state} {where} {runs}"),
        ("Forecast, with the duration of the programs:", f"hil schedule plan {file} {state}"),
    ]
