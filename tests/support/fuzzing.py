"""What the fuzz tests share: how many examples, and mutations of documents that were right.

`make test` runs the numbers written at the tests; `make fuzz` sets HIL_FUZZ_EXAMPLES to run many
more of each, from other seeds every time.
"""

from __future__ import annotations

import contextlib
import copy
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

LONG = int(os.environ.get("HIL_FUZZ_EXAMPLES", "0"))
DEADLINE_MS = 20_000
"""What takes longer hangs; a busy machine does not."""


def examples(count: int) -> Callable[[Any], Any]:
    """Settings of a fuzz test that has `count` examples in `make test`."""
    return settings(
        max_examples=LONG or count,
        deadline=DEADLINE_MS,
        derandomize=not LONG,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


@contextlib.contextmanager
def quick_folder() -> Iterator[Path]:
    """A folder for thousands of small files: in memory where the system has such a place."""
    memory = Path("/dev/shm")
    parent = memory if os.access(memory, os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="hil-test-", dir=parent) as folder:
        yield Path(folder)


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 20),
    st.sampled_from(
        [2**31, 2**63, -(2**63), 10**12, 10**30, 1e308, -1e308, 5e-324, -0.0, 0.5, 1e400, -1e400]
    ),
    st.just(float("nan")),
    st.text(max_size=12),
    st.sampled_from(["", "0", "nan", "1e400", "../..", "/", "\x00", "é́", "💥", "<b>", "dwell"]),
)
"""Values nobody expects where they stand."""


def deep(levels: int) -> Any:
    """A list in a list in a list …"""
    nested: Any = []
    for _ in range(levels):
        nested = [nested]
    return nested


def _wrapped(levels: int) -> Callable[[Any], Any]:
    def wrap(value: Any) -> Any:
        for level in range(levels):
            value = {"kind": value} if level % 2 else [value]
        return value

    return wrap


ANYTHING = st.one_of(
    SCALARS,
    st.lists(SCALARS, max_size=4),
    st.dictionaries(st.text(max_size=6), SCALARS, max_size=3),
    st.integers(1, 300).map(deep),
)


def places_in(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Path of every node of a document, the top left out."""
    children: Any = ()
    if isinstance(value, dict):
        children = value.items()
    elif isinstance(value, list):
        # A long list is the same thing again: its ends will do.
        numbered = list(enumerate(value))
        children = numbered[:3] + numbered[3:][-2:]
    inner = [place for key, child in children for place in places_in(child, (*path, key))]
    return [path, *inner] if path else inner


@st.composite
def damaged(draw: st.DrawFn, documents: list[Any], most: int = 3) -> Any:
    """One of the documents with a few nodes deleted, doubled, replaced or moved."""
    document = copy.deepcopy(draw(st.sampled_from(documents)))
    for _ in range(draw(st.integers(1, most))):
        places = places_in(document)
        if not places:
            return draw(ANYTHING)
        *way, last = draw(st.sampled_from(places))
        holder = document
        for step in way:
            holder = holder[step]
        _damage(draw, document, holder, last, places)
    return document


def _damage(draw: st.DrawFn, document: Any, holder: Any, last: Any, places: Any) -> None:
    how = draw(st.sampled_from(["delete", "double", "replace", "wrap", "move", "scale"]))
    value = holder[last]
    if how == "delete":
        del holder[last]
    elif how == "double" and isinstance(holder, list):
        holder.insert(last, copy.deepcopy(value))
    elif how == "double":
        holder[str(last) + draw(st.text(max_size=3))] = copy.deepcopy(value)
    elif how == "wrap":
        holder[last] = draw(st.integers(1, 60).map(_wrapped))(value)
    elif how == "move":
        holder[last] = copy.deepcopy(_at(document, draw(st.sampled_from(places))))
    elif how == "scale" and isinstance(value, int | float) and not isinstance(value, bool):
        holder[last] = value * draw(st.sampled_from([-1, 0, 1e-12, 0.5, 3, 1000, 10**9, 10**15]))
    else:
        holder[last] = draw(ANYTHING)


def _at(document: Any, place: tuple[Any, ...]) -> Any:
    for step in place:
        document = document[step]
    return document
