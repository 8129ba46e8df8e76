"""Parser for run queries such as `robot=ur5-* since=7d rmse<0.1 shoulder`; yields parametrized SQL.

A run matches a query if the run matches every term of the query. A query term is either a key, a
comparison operator and a value, or a search word that must occur in the name, the description or
the operator of the run. If a query has several terms about fits (`estimator`, `rmse`), one and the
same fit of the run must match all of them.
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
"""Keys whose values are compared as text; a value can contain the wildcards `*`, `?` and `[…]`."""

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
    """SQL conditions, all of which a run must satisfy.

    Attributes:
        conditions: SQL expressions with a question mark for every value.
        values: Values in the order of the question marks.
    """

    conditions: tuple[str, ...]
    values: tuple[Any, ...]

    @property
    def select(self) -> str:
        """SQL statement that selects the path and the catalogue entry of the matching runs."""
        where = " AND ".join(f"({one})" for one in self.conditions) or "1"
        return f"SELECT path, entry FROM runs WHERE {where}"  # noqa: S608 - values are SQL parameters


@dataclass(frozen=True, slots=True)
class _Term:
    text: str
    key: str
    comparison: str
    value: str


def sqlite_text(text: str) -> str:
    """Return a text that SQLite accepts, with invalid characters of file names replaced."""
    return text.encode("utf-8", "replace").decode()


def parse(terms: Iterable[str], now: float | None = None) -> Query:
    """Parse the query terms and return the SQL condition for runs.

    Args:
        terms: Query terms as the user typed them.
        now: Reference time for durations such as `7d` [s, Unix time]; defaults to the current time.

    Raises:
        SpecError: A query term cannot be parsed.
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
        # Without quotes, the shell redirects `duration>60` to a file `60` and passes `duration`.
        raise SpecError(
            f"{text!r} lacks a comparison",
            hint=f"add an operator and a value, in quotes: '{key}{_example(key)}'",
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
        raise SpecError(f"{text!r}: unknown key {key!r}", hint=hint)
    if not value.strip():
        raise SpecError(f"{text!r} lacks a value", hint=f"for example: {known}{_example(known)}")
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
            f"{term.text!r}: unknown {term.key} {term.value!r}",
            hint=did_you_mean(term.value, words),
        )
    sql = f"{term.key} GLOB ?" if pattern else f"{term.key} = ?"
    return (f"NOT {sql}" if term.comparison == "!=" else sql), (term.value,)


def _of_fits(terms: list[_Term]) -> list[Condition]:
    """Return the SQL condition that results from the terms about fits.

    One and the same fit must match all terms about fits; estimators excluded by a term must not
    occur in any fit of the run.
    """
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
            f"{term.text!r}: {term.value!r} is not a number",
            hint=f"for example: {term.key}{_example(term.key)}",
        )
    return value


def _time(term: _Term, now: float) -> Condition:
    """Return the SQL condition on the start time of a run.

    A duration such as `7d` is subtracted from the time `now`. A date without a time means the whole
    day in local time.
    """
    since = term.key == "since"
    sql = "started >= ?" if since else "started < ?"

    def midnight(text: str) -> float:
        day = date.fromisoformat(text) + timedelta(days=0 if since else 1)  # `until` is inclusive
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
        f"{term.text!r}: {term.value!r} is neither a date, nor a time, nor a duration",
        hint=f"{term.key}=2026-11-21, {term.key}=2026-11-21T14:30 or {term.key}=7d (7 days ago)",
    )
