"""The catalogue as SQLite: `RUNS/.catalogue.sqlite`, a view of run directories and never the truth.

Every look at it compares the directories with what it holds and reads those that have changed. The
file is taken into memory whole and replaced whole: processes need no locks, which network file
systems lack, a kill leaves the file before, and where nothing can be written nothing is. A file
that is damaged or of another version is made anew.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.core import RecordingError, write_replacing
from hil.runs.facts import facts_of, started_s
from hil.runs.listing import run_paths
from hil.runs.query import Query, parse, plain
from hil.runs.stamp import ALWAYS_READ, stamp_of

FILE = ".catalogue.sqlite"
VERSION = 2
"""Raised whenever a column or an entry changes: files of other versions are made anew."""

_TEXTS = ("name", "robot", "arm", "serial", "operator", "status", "verdict", "occasion", "uid")
_NUMBERS = ("number", "started", "duration", "samples", "gaps", "load")
_WORDS = ("name", "description", "operator")
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
    """Runs that meet every term of a query, by number; without terms all of them.

    Args:
        terms: Such as `robot=ur5-*`, `since=7d`, `rmse<0.1` or a word; see
            docs/how-to/find-runs.md.
        runs: The folder of runs.
        rebuild: Read every directory again.

    Returns:
        One entry per run, see `hil.runs.facts.facts_of`.

    Raises:
        SpecError: A term cannot be understood.
        DataError: `runs` is a file.
    """
    root, query = Path(runs), parse(terms)
    paths = {_relative(path, root): path for path in run_paths(root)}
    found = None if rebuild else _kept(root, paths, query)
    if found is None:
        with contextlib.closing(_new()) as view:
            _bring_up_to_date(view, root, paths)
            found = _asked(view, query)
    entries = [entry | {"run": str(paths[path])} for path, entry in found]
    return sorted(entries, key=lambda one: (one["number"], Path(one["run"])))


def _kept(
    root: Path, paths: Mapping[str, Path], query: Query
) -> list[tuple[str, dict[str, Any]]] | None:
    """What the file says, brought up to date; None where there is none that can be used."""
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as view:
        try:
            view.deserialize((root / FILE).read_bytes())
            if _only(view, "PRAGMA user_version") != VERSION:
                return None
            if _only(view, "PRAGMA quick_check(1)") != "ok":
                return None
            _bring_up_to_date(view, root, paths)
            return _asked(view, query)
        except (sqlite3.Error, OSError, ValueError, TypeError):  # an entry is no JSON or no object
            return None


def _new() -> sqlite3.Connection:
    view = sqlite3.connect(":memory:", isolation_level=None)
    for statement in _TABLES:
        view.execute(statement)
    return view


def _only(view: sqlite3.Connection, statement: str) -> Any:
    (value,) = view.execute(statement).fetchone()
    return value


def _asked(view: sqlite3.Connection, query: Query) -> list[tuple[str, dict[str, Any]]]:
    rows = view.execute(query.select, query.values)
    return [(path, json.loads(entry)) for path, entry in rows]


def _bring_up_to_date(view: sqlite3.Connection, root: Path, paths: Mapping[str, Path]) -> None:
    """Forget what is gone, read what has changed, and keep the file where that is worth it."""
    known = dict(view.execute("SELECT path, stamp FROM runs"))
    stamps = {path: stamp_of(run) for path, run in paths.items()}
    gone = [path for path, stamp in known.items() if not stamp or stamps.get(path) != stamp]
    view.execute("BEGIN")
    for path in gone:
        view.execute("DELETE FROM runs WHERE path = ?", (path,))
        view.execute("DELETE FROM fits WHERE path = ?", (path,))
    new = [path for path in paths if path not in known or path in gone]
    passing = [path for path in new if not _read(view, path, paths[path], stamps[path])]
    view.execute("COMMIT")
    if any(known[path] for path in gone) or len(passing) < len(new):
        _keep(view, root)


def _read(view: sqlite3.Connection, path: str, run: Path, stamp: str) -> bool:
    """Enter a run; False where it has to be read again the next time."""
    facts = None
    with contextlib.suppress(FileNotFoundError):
        facts = facts_of(run)
    if facts is None or not run.is_dir():
        return False  # deleted meanwhile
    lasts = facts["status"] not in ("running", "interrupted", "damaged")
    stamp = stamp if lasts else ALWAYS_READ
    told = facts | {
        "path": path,
        "stamp": stamp,
        "entry": json.dumps(facts | {"run": ""}),
        "words": "\n".join(facts[one] for one in _WORDS).casefold(),
        "run": run.name,
        "started": started_s(facts),
        "duration": facts["duration_s"],
        "load": max(facts["loads_kg"], default=None),
    }
    view.execute(_ADD, [_plain(told[column]) for column in _COLUMNS])
    for fit in facts["fits"]:
        row = (path, _plain(fit["estimator"]), fit["rmse"])
        view.execute("INSERT INTO fits VALUES (?, ?, ?)", row)
    return stamp != ALWAYS_READ


def _plain(value: Any) -> Any:
    return plain(value) if isinstance(value, str) else value


def _keep(view: sqlite3.Connection, root: Path) -> None:
    with contextlib.suppress(RecordingError, sqlite3.Error):  # then it is made anew next time
        write_replacing(root / FILE, view.serialize())


def _relative(path: Path, root: Path) -> str:
    """Where a run is below the folder of runs, as ASCII whatever bytes its name has."""
    return json.dumps(os.fspath(path.relative_to(root)))
