"""The catalogue as SQLite: `RUNS/.catalogue.sqlite`, a view of run directories and never the truth.

Every query first compares the directories with the file and reads those that have changed: in which
a name, a time or a size is another one (`stamp_of`). The file is read into memory whole and
replaced whole, so that processes need no locks, which network file systems lack, and a kill leaves
the older file. A file that is damaged or of another version is made anew. A folder of runs that
cannot be written to is queried all the same, only more slowly.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hil.core import LOCK, RecordingError, write_replacing
from hil.runs.listing import facts_of, run_paths, started_s
from hil.runs.query import Query, parse, sqlite_text

FILE = ".catalogue.sqlite"

VERSION = 2
"""Raised whenever a column or an entry changes: files of other versions are made anew."""

_WORDS = ("name", "description", "operator")
_TEXTS = ("name", "robot", "arm", "serial", "operator", "status", "verdict", "occasion", "uid")
_NUMBERS = ("number", "started", "duration", "samples", "gaps", "load")
_COLUMNS = ("path", "stamp", "entry", "words", "run", *_TEXTS, *_NUMBERS)
_TABLES = (
    f"CREATE TABLE runs ({', '.join(_COLUMNS)}, PRIMARY KEY (path))",
    "CREATE TABLE fits (path, estimator, rmse)",
    "CREATE INDEX fits_of ON fits (path)",
    f"PRAGMA user_version = {VERSION}",
)
_ADD = f"INSERT INTO runs VALUES ({', '.join('?' * len(_COLUMNS))})"  # noqa: S608 - names of ours


def find_runs(
    *terms: str, runs: str | Path = "runs", rebuild: bool = False
) -> list[dict[str, Any]]:
    """Return the runs that meet every term of a query, by number; without terms all of them.

    Args:
        terms: Such as `robot=ur5-*`, `since=7d`, `rmse<0.1` or a word; see
            docs/how-to/find-runs.md.
        runs: The folder of runs.
        rebuild: Read every directory again.

    Returns:
        One entry per run, see `hil.runs.listing.facts_of`.

    Raises:
        SpecError: A term cannot be understood.
        DataError: `runs` is a file.
    """
    root, query = Path(runs), parse(terms)
    paths = {_relative(path, root): path for path in run_paths(root)}
    rows = None if rebuild else _from_file(root, paths, query)
    if rows is None:
        with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as view:
            for statement in _TABLES:
                view.execute(statement)
            _bring_up_to_date(view, root, paths)
            rows = _select(view, query)
    entries = [entry | {"run": str(paths[path])} for path, entry in rows]
    return sorted(entries, key=lambda one: (one["number"], Path(one["run"])))


def _relative(path: Path, root: Path) -> str:
    """Return where a run is below the folder of runs, as ASCII whatever bytes its name has."""
    return json.dumps(os.fspath(path.relative_to(root)))


def _from_file(
    root: Path, paths: Mapping[str, Path], query: Query
) -> list[tuple[str, dict[str, Any]]] | None:
    """Return the answer of the file, brought up to date; None without a file that can be used."""
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as view:
        try:
            view.deserialize((root / FILE).read_bytes())
            if _only(view, "PRAGMA user_version") != VERSION:
                return None
            if _only(view, "PRAGMA quick_check(1)") != "ok":
                return None
            _bring_up_to_date(view, root, paths)
            return _select(view, query)
        except (sqlite3.Error, OSError, ValueError, TypeError):  # an entry is no JSON or no object
            return None


def _only(view: sqlite3.Connection, statement: str) -> Any:
    (value,) = view.execute(statement).fetchone()
    return value


def _bring_up_to_date(view: sqlite3.Connection, root: Path, paths: Mapping[str, Path]) -> None:
    """Forget what is gone, read what has changed, and write the file if another query gains by it.

    Nothing is gained by runs alone that are read every time (`ALWAYS_READ`).
    """
    known = dict(view.execute("SELECT path, stamp FROM runs"))
    stamps = {path: stamp_of(run) for path, run in paths.items()}
    outdated = [path for path, stamp in known.items() if not stamp or stamps.get(path) != stamp]
    view.execute("BEGIN")
    for path in outdated:
        view.execute("DELETE FROM runs WHERE path = ?", (path,))
        view.execute("DELETE FROM fits WHERE path = ?", (path,))
    new = [path for path in paths if path not in known or path in outdated]
    lasting = [path for path in new if _enter(view, path, paths[path], stamps[path])]
    view.execute("COMMIT")
    if any(known[path] for path in outdated) or lasting:
        with contextlib.suppress(RecordingError, sqlite3.Error):  # made anew by the next query
            write_replacing(root / FILE, view.serialize())


def _enter(view: sqlite3.Connection, path: str, run: Path, stamp: str) -> bool:
    """Enter a run; return whether its entry lasts, or has to be read again the next time."""
    facts = None
    with contextlib.suppress(FileNotFoundError):
        facts = facts_of(run)
    if facts is None or not run.is_dir():
        return False  # deleted meanwhile
    ended = facts["status"] not in ("running", "interrupted", "damaged")
    stamp = stamp if ended else ALWAYS_READ
    row = facts | {
        "path": path,
        "stamp": stamp,
        "entry": json.dumps(facts | {"run": ""}),
        "words": "\n".join(facts[one] for one in _WORDS).casefold(),
        "run": run.name,
        "started": started_s(facts),
        "duration": facts["duration_s"],
        "load": max(facts["loads_kg"], default=None),
    }
    view.execute(_ADD, [_sqlite_value(row[column]) for column in _COLUMNS])
    for fit in facts["fits"]:
        values = (path, _sqlite_value(fit["estimator"]), fit["rmse"])
        view.execute("INSERT INTO fits VALUES (?, ?, ?)", values)
    return stamp != ALWAYS_READ


def _sqlite_value(value: Any) -> Any:
    return sqlite_text(value) if isinstance(value, str) else value


def _select(view: sqlite3.Connection, query: Query) -> list[tuple[str, dict[str, Any]]]:
    rows = view.execute(query.select, query.values)
    return [(path, json.loads(entry)) for path, entry in rows]


ALWAYS_READ = ""
"""Stamp of a run that is read again by every query, whatever its files look like."""

SETTLED_S = 2.0
"""A file that was changed less long ago may change again within the same tick of a clock [s]."""


def stamp_of(run: Path) -> str:
    """Return a text that changes whenever the entry of a run may have changed.

    It is `ALWAYS_READ` if that cannot be known: for a run that was changed a moment ago (such as a
    live one, whose process touches its lock), and for one that cannot be looked into.
    """
    try:
        seen = sorted(_seen(run))
    except OSError:
        return ALWAYS_READ
    newest = max((changed for _, changed, _ in seen), default=0)
    if newest > time.time_ns() - int(SETTLED_S * 1e9):
        return ALWAYS_READ
    return ";".join(f"{name}:{changed}:{size}" for name, changed, size in seen)


_FOLDERS = ("fit", "study")
_PARTS = ("evaluation.json", "model.json", "study.json")


def _seen(run: Path) -> Iterator[tuple[str, int, int]]:
    """Yield name, time of change [ns] and size of everything that an entry depends on."""
    home = os.fspath(run)  # text: a Path per file would be several times slower, of thousands
    yield _look("", home)
    with os.scandir(home) as entries:
        inside = [entry for entry in entries if entry.name[0] != "." or entry.name == LOCK]
    for entry in inside:
        status = entry.stat()
        yield entry.name, status.st_mtime_ns, 0 if entry.is_dir() else status.st_size
        if entry.name in _FOLDERS and entry.is_dir():
            yield from _below(entry.name, entry.path)


def _below(name: str, folder: str) -> Iterator[tuple[str, int, int]]:
    with os.scandir(folder) as entries:
        inside = [entry for entry in entries if entry.is_dir()]
    for entry in inside:
        yield _look(f"{name}/{entry.name}", entry.path)
        for part in _PARTS:
            try:
                yield _look(f"{name}/{entry.name}/{part}", f"{entry.path}/{part}")
            except FileNotFoundError:
                continue


def _look(name: str, path: str) -> tuple[str, int, int]:
    status = os.stat(path)
    return name, status.st_mtime_ns, status.st_size
