"""SQLite catalogue of the run directories: a cache in the file `RUNS/.catalogue.sqlite`.

The run directories, not the catalogue, remain the source of truth. Every query first compares the
run directories with the catalogue. A run directory is read again if the name, modification time or
size of one of its files differs (`stamp_of`).

The catalogue file is read into memory as a whole and replaced as a whole. Processes that update the
catalogue file therefore need no locks, which some network file systems do not support. A killed
process leaves the previous catalogue file intact. A catalogue file that is damaged or has a
different format version is rebuilt. If the folder of runs is not writable, queries still work but
are slower, because the catalogue file is not updated.
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
"""Format version of the catalogue file.

Increase the format version whenever a column or an entry changes; catalogue files of other versions
are rebuilt.
"""

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
_ADD = f"INSERT INTO runs VALUES ({', '.join('?' * len(_COLUMNS))})"  # noqa: S608 - constant names


def find_runs(
    *terms: str, runs: str | Path = "runs", rebuild: bool = False
) -> list[dict[str, Any]]:
    """Return the runs that match all terms of a query, sorted by run number.

    Without query terms, all runs are returned.

    Args:
        terms: Query terms such as `robot=ur5-*`, `since=7d`, `rmse<0.1` or a search word, as
            described in docs/how-to/find-runs.md.
        runs: Path of the folder of runs.
        rebuild: Whether to ignore the catalogue file and read every run directory again.

    Returns:
        One entry per matching run; the keys are described in `hil.runs.listing.facts_of`.

    Raises:
        SpecError: A query term cannot be parsed.
        DataError: The path `runs` is a file.
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
    """Return the path of a run relative to the folder of runs, in JSON with ASCII characters."""
    return json.dumps(os.fspath(path.relative_to(root)))


def _from_file(
    root: Path, paths: Mapping[str, Path], query: Query
) -> list[tuple[str, dict[str, Any]]] | None:
    """Return the query result from the updated catalogue file; None if it is unusable."""
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as view:
        try:
            view.deserialize((root / FILE).read_bytes())
            if _only(view, "PRAGMA user_version") != VERSION:
                return None
            if _only(view, "PRAGMA quick_check(1)") != "ok":
                return None
            _bring_up_to_date(view, root, paths)
            return _select(view, query)
        except (sqlite3.Error, OSError, ValueError, TypeError):  # includes invalid JSON
            return None


def _only(view: sqlite3.Connection, statement: str) -> Any:
    (value,) = view.execute(statement).fetchone()
    return value


def _bring_up_to_date(view: sqlite3.Connection, root: Path, paths: Mapping[str, Path]) -> None:
    """Remove deleted runs from the catalogue and read changed runs.

    The catalogue file is written only if a later query benefits from the changes. If every query
    reads all changed runs again in any case (`ALWAYS_READ`), the catalogue file is not written.
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
        with contextlib.suppress(RecordingError, sqlite3.Error):  # the next query rebuilds the file
            write_replacing(root / FILE, view.serialize())


def _enter(view: sqlite3.Connection, path: str, run: Path, stamp: str) -> bool:
    """Add a run to the catalogue and return whether later queries can reuse its entry."""
    facts = None
    with contextlib.suppress(FileNotFoundError):
        facts = facts_of(run)
    if facts is None or not run.is_dir():
        return False  # the run was deleted in the meantime
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
"""Stamp of a run that every query reads again, whatever the state of its files."""

SETTLED_S = 2.0
"""Minimum time since the last change of a file for its run to be reused from the catalogue [s].

A file that was changed more recently can change again with the same modification time, because the
clock of the file system is coarse.
"""


def stamp_of(run: Path) -> str:
    """Return a text that changes whenever the catalogue entry of a run possibly changes.

    The text is `ALWAYS_READ` if changes of the run cannot be detected. Changes cannot be detected
    in a directory that cannot be read. Changes also cannot be detected in a run whose files were
    changed within the last `SETTLED_S` seconds, such as a live run whose process touches its lock
    file.
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
    """Yield name, modification time [ns] and size of every file that an entry depends on."""
    home = os.fspath(run)  # a Path object per file would be several times slower
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
