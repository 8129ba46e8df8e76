"""Queries of runs, such as `robot=ur5-* since=7d rmse<0.1 shoulder`, as SQL with parameters.

Every term must be met. A term is a key, a comparison and a value, or a word that is looked for in
name, description and operator. Terms about fits (`estimator`, `rmse`) must be met by one and the
same fit of the run.
"""

from __future__ import annotations

import contextlib
import math
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from typing import Any, get_args

from hil.core import SpecError, did_you_mean, duration_of
from hil.evaluation import VerdictWord
from hil.runs.listing import ListedStatus

_TERM = re.compile(r"([A-Za-z_-]+)\s*(<=|>=|!=|==|=|<|>)(.*)", re.DOTALL)

TEXTS = (
    "run", "name", "robot", "arm", "serial", "operator", "status", "verdict", "occasion", "uid",
)  # fmt: skip
"""Compared as they are written; `*`, `?` and `[…]` stand for others."""

NUMBERS = ("number", "duration", "samples", "gaps", "load")
OF_FITS = ("estimator", "rmse")
TIMES = ("since", "until")
KEYS = (*TEXTS, *NUMBERS, *OF_FITS, *TIMES)
_SYNONYMS = {"outcome": "status"}
_WORDS: dict[str, tuple[str, ...]] = {
    "status": tuple(word for part in get_args(ListedStatus) for word in get_args(part) or (part,)),
    "verdict": get_args(VerdictWord),
}

Condition = tuple[str, tuple[Any, ...]]


@dataclass(frozen=True, slots=True)
class Query:
    """Conditions in SQL, all of which must hold.

    Attributes:
        conditions: With `?` for every value.
        values: In the order of the question marks.
    """

    conditions: tuple[str, ...]
    values: tuple[Any, ...]

    @property
    def select(self) -> str:
        """The statement that selects path and entry of the runs."""
        where = " AND ".join(f"({one})" for one in self.conditions) or "1"
        return f"SELECT path, entry FROM runs WHERE {where}"  # noqa: S608 - values are parameters


@dataclass(frozen=True, slots=True)
class _Term:
    text: str
    key: str
    comparison: str
    value: str


def sqlite_text(text: str) -> str:
    """Return a text that SQLite takes: names of files, and terms, may be of any bytes."""
    return text.encode("utf-8", "replace").decode()


def parse(terms: Iterable[str], now: float | None = None) -> Query:
    """Return the query of some terms.

    Args:
        terms: As typed.
        now: What durations count back from [s, Unix]; by default the present moment.

    Raises:
        SpecError: One cannot be understood.
    """
    now = time.time() if now is None else now
    words: list[str] = []
    compared: list[_Term] = []
    for text in map(sqlite_text, terms):
        match = _TERM.fullmatch(text.strip())
        if match is None:
            words.append(_word(text))
        else:
            compared.append(_term(text, *match.groups()))
    conditions: list[Condition] = [("instr(words, ?) > 0", (word.casefold(),)) for word in words]
    for term in compared:
        if term.key in TIMES:
            conditions.append(_time(term, now))
        elif term.key in NUMBERS:
            conditions.append((f"{term.key} {term.comparison} ?", (_number(term),)))
        elif term.key in TEXTS:
            conditions.append(_text(term))
    conditions += _of_fits([term for term in compared if term.key in OF_FITS])
    return Query(
        tuple(sql for sql, _ in conditions),
        tuple(value for _, values in conditions for value in values),
    )


def _word(text: str) -> str:
    key = _SYNONYMS.get(text, text)
    if key in (*NUMBERS, *OF_FITS, *TIMES):
        # The shell takes `duration>60` without quotes as `duration`, redirected into a file `60`.
        raise SpecError(
            f"{text!r} alone asks nothing",
            hint=f"compare it with something, in quotes: '{key}{_example(key)}'",
        )
    return text.strip()


def _example(key: str) -> str:
    if key in TIMES:
        return "=7d"
    return "=rigid-*" if key == "estimator" else {"rmse": "<0.1"}.get(key, ">10")


def _term(text: str, key: str, comparison: str, value: str) -> _Term:
    known = _SYNONYMS.get(key.lower().replace("-", "_"), key.lower())
    if known not in KEYS:
        hint = did_you_mean(key, (*KEYS, *_SYNONYMS))
        raise SpecError(f"{text!r}: runs cannot be asked for {key!r}", hint=hint)
    if not value.strip():
        raise SpecError(f"{text!r} lacks a value", hint=f"such as {known}{_example(known)}")
    comparison = "=" if comparison == "==" else comparison
    allowed: tuple[str, ...] = ("=",) if known in TIMES else ("=", "!=", "<", "<=", ">", ">=")
    if known in (*TEXTS, "estimator"):
        allowed = ("=", "!=")
    if comparison not in allowed:
        raise SpecError(
            f"{text!r}: {known} cannot be compared with {comparison}",
            hint=f"use {known} with {' or '.join(allowed)}",
        )
    return _Term(text, known, comparison, value.strip())


def _text(term: _Term) -> Condition:
    pattern = any(letter in term.value for letter in "*?[")
    words = _WORDS.get(term.key, ())
    if words and not pattern and term.value not in words:
        raise SpecError(
            f"{term.text!r}: {term.key} is never {term.value!r}",
            hint=did_you_mean(term.value, words),
        )
    sql = f"{term.key} GLOB ?" if pattern else f"{term.key} = ?"
    return (f"NOT {sql}" if term.comparison == "!=" else sql), (term.value,)


def _of_fits(terms: list[_Term]) -> list[Condition]:
    """Return what one and the same fit must meet, and estimators that no fit may have."""
    excluded = [term for term in terms if term.key == "estimator" and term.comparison == "!="]
    conditions = [_exists([_text(replace(term, comparison="="))], "NOT ") for term in excluded]
    required = [
        _text(term) if term.key == "estimator" else (f"rmse {term.comparison} ?", (_number(term),))
        for term in terms
        if term not in excluded
    ]
    return [*conditions, _exists(required, "")] if required else conditions


def _exists(conditions: list[Condition], negation: str) -> Condition:
    met = " AND ".join(f"({sql})" for sql, _ in conditions)
    values = tuple(value for _, some in conditions for value in some)
    of_run = "fits.path = runs.path"
    return f"{negation}EXISTS (SELECT 1 FROM fits WHERE {of_run} AND {met})", values  # noqa: S608


def _number(term: _Term) -> float:
    value = math.nan
    with contextlib.suppress(ValueError):
        value = float(term.value)
    if term.key == "duration" and math.isnan(value):
        with contextlib.suppress(ValueError):
            value = duration_of(term.value).total_seconds()
    if not math.isfinite(value):
        raise SpecError(
            f"{term.text!r}: {term.value!r} is no number",
            hint=f"such as {term.key}{_example(term.key)}",
        )
    return value


def _time(term: _Term, now: float) -> Condition:
    """Return a condition on the start: `7d` counts back from now, a day is whole and local time."""
    since = term.key == "since"
    sql = "started >= ?" if since else "started < ?"

    def midnight(text: str) -> float:
        day = date.fromisoformat(text) + timedelta(days=0 if since else 1)  # until its end
        return datetime(day.year, day.month, day.day).timestamp()

    readers: tuple[Callable[[str], float], ...] = (
        lambda text: now - duration_of(text).total_seconds(),
        midnight,
        lambda text: datetime.fromisoformat(text).timestamp(),
    )
    for read in readers:
        with contextlib.suppress(ValueError, OverflowError, OSError):
            return sql, (read(term.value),)
    raise SpecError(
        f"{term.text!r}: {term.value!r} is no time",
        hint=f"{term.key}=2026-11-21, {term.key}=2026-11-21T14:30 or, back from now, {term.key}=7d",
    )
