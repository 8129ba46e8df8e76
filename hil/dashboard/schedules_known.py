"""Schedules that are kept or offered here: their files, their ledgers, and what is due next."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from itertools import islice, takewhile
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from hil.core import LOCK, MOST_BYTES, HilError, holder_of, quoted, read_source
from hil.dashboard.settings import Settings
from hil.maintenance import LEDGER_FILE, Ledger, ahead, occasions
from hil.recording import folders_in
from hil.spec import KEY, ScheduleSpec, load_schedule_spec

LOOKED_AT = 2000
"""Files below the folder of specs; somebody may have named their home."""

DEEPEST = 4
COMING = 8
AHEAD = timedelta(days=28)
_PLAIN = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}")


@dataclass(frozen=True, slots=True)
class Known:
    """A schedule.

    Attributes:
        name: Of the schedule.
        folder: Of its state, which may not be there yet.
        file: Its own; None where none of the files offered is of this schedule.
        spec: What the file says, None where it cannot be read.
        ledger: What became of everything, empty before it is started; None where it is damaged.
        problems: What cannot be read, and why.
    """

    name: str
    folder: Path
    file: Path | None
    spec: ScheduleSpec | None
    ledger: Ledger | None
    problems: tuple[str, ...]

    @property
    def address(self) -> str:
        """Path of its page."""
        return f"/schedules/{quoted(self.name)}"

    @property
    def zone(self) -> ZoneInfo:
        """In which its times are told."""
        return ZoneInfo(self.spec.timezone if self.spec else "UTC")

    @property
    def held(self) -> str:
        """Why nothing begins; empty where things do."""
        if self.ledger is None:
            return "its ledger cannot be read"
        standing = self.ledger.standing
        if standing.held is not None:
            return str(standing.held.get("why") or "no reason was given")
        return ahead(standing, datetime.now(UTC))

    @property
    def run_by(self) -> str:
        """The process that keeps it; empty where nobody does."""
        holder = holder_of(self.folder / LOCK) if self.folder.is_dir() else None
        return holder.told(self.zone) if holder else ""

    def due(self, most: int) -> list[tuple[datetime, str]]:
        """The next occasions that are not settled, as moments (UTC) and jobs."""
        if self.spec is None or self.ledger is None:
            return []
        now, standing = datetime.now(UTC), self.ledger.standing
        after = max(now, standing.until or now)
        found = occasions(self.spec, standing.anchor or now, after)
        near = takewhile(lambda one: one.due <= now + AHEAD, found)
        return [(one.due, one.job) for one in islice(near, most)]


def known_schedules(settings: Settings) -> list[Known]:
    """Schedules with a state, and those whose files are offered; by name."""
    files = _offered(settings.specs)
    states = [path for path in folders_in(settings.schedules) if (path / LEDGER_FILE).is_file()]
    names = {path.name for path in states} | set(files)
    return [_known(name, settings, files.get(name)) for name in sorted(names)]


def coming(settings: Settings) -> list[dict[str, Any]]:
    """What is due next, of all schedules that were started, soonest first.

    Returns:
        `name`, `address`, `job` (`probe` or `campaign`), `due` (UTC), `when` (in the schedule's
        zone, in words), `held` (why it will not be done; empty where nothing holds it) and `run_by`
        (who would do it; empty where nobody runs the schedule) each.
    """
    found: list[dict[str, Any]] = []
    for one in known_schedules(settings):
        if one.ledger is None or not one.ledger.lines:
            continue
        told = {"name": one.name, "address": one.address, "held": one.held, "run_by": one.run_by}
        found += [
            {**told, "due": due, "when": f"{moment_words(due, one.zone)} ({one.zone})", "job": job}
            for due, job in one.due(COMING)
        ]
    return sorted(found, key=lambda each: each["due"])[:COMING]


def moment_words(moment: datetime, zone: ZoneInfo) -> str:
    """`Sat 28 Nov 2026, 03:00` there."""
    return f"{moment.astimezone(zone):%a %d %b %Y, %H:%M}"


def _known(name: str, settings: Settings, file: Path | None) -> Known:
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
    return Known(name, folder, file, spec, ledger, tuple(problems))


def _offered(specs: Path | None) -> dict[str, Path]:
    """Names and files of the schedules below a folder."""
    if specs is None:
        return {}
    found: dict[str, Path] = {}
    for entry in islice(_files_below(specs), LOOKED_AT):
        if entry.name.endswith((".yaml", ".yml")) and (name := _name_in(entry)):
            found.setdefault(name, Path(entry))
    return found


@lru_cache(maxsize=LOOKED_AT)
def _name_of(path: Path, changed: int, size: int) -> str:
    """Name of the schedule in a file; empty where it is no schedule. Read once per change."""
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


def _name_in(entry: os.DirEntry[str]) -> str:
    told = entry.stat()
    # Larger ones no spec is.
    return (
        _name_of(Path(entry), told.st_mtime_ns, told.st_size) if told.st_size < MOST_BYTES else ""
    )


def _files_below(folder: Path, depth: int = 0) -> Iterator[os.DirEntry[str]]:
    """Those of a folder first, then those of the folders in it."""
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
