"""Templates whose comments are made from the models: what a key means, in which unit and range.

A line of a template that ends in `#?` gets the description of its key, and what stands behind `#?`
is added to it. Comments can say nothing else than the reference page does.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from functools import cache
from importlib.resources import files

from hil.core import SpecError
from hil.spec.describe import KeyInfo, keys_below
from hil.spec.model_tree import Model

COLUMN = 36
"""Where comments begin, and where whoever writes a line behind a template's key goes on."""
WIDTH = 100
NARROWEST = 40
"""Comments that have less room stand above their line."""

_LINE = re.compile(
    r"(?P<indent> *)(?P<off># )?(?P<dash>- )?(?P<key>[\w.<>-]+|\"[\w.-]+\"):(?P<rest>.*)"
)
_MARK = "  #?"


def commented(text: str, model: Model) -> str:
    """A template with the comments of a model's keys.

    Args:
        text: YAML whose lines may end in `  #? more`.
        model: What the file is an instance of.

    Raises:
        SpecError: A marked line is of a key that the model has not.
    """
    known = list(keys_below(model))
    return "\n".join(line for one in _lines(text) for line in _written(one, known)) + "\n"


def comment_of(info: KeyInfo, more: str = "") -> str:
    """A sentence about a key: unit and range, meaning, and what else there is to say."""
    allowed = info.allowed.replace("`", "")
    limits = re.sub(r"^(whole )?number ?", "", allowed)
    if not re.match(r"(whole )?number", allowed):
        limits = allowed if " or " in allowed and not info.allowed.startswith("list") else ""
    head = ", ".join(part for part in (info.unit, limits) if part)
    said = f"{head}: {info.meaning}" if head else info.meaning
    return f"{said} {more}".strip()


def _lines(text: str) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Each line with the path of its key and the `kind` of the mapping it is in."""
    stack: list[tuple[int, str]] = []
    kinds: dict[tuple[str, ...], str] = {}
    for line in text.splitlines():
        found = _LINE.fullmatch(line)
        if found is None:
            yield line, (), ""
            continue
        depth = len(found["indent"]) + len(found["dash"] or "")
        stack = [(at, key) for at, key in stack if at < depth]
        above = tuple(key for _, key in stack)
        if not found["off"]:
            stack.append((depth, found["key"]))
        if found["key"] == "kind":
            kinds[above] = found["rest"].strip()
        yield line, (*above, found["key"]), kinds.get(above, "")


def _written(line: tuple[str, tuple[str, ...], str], known: list[KeyInfo]) -> Iterator[str]:
    text, path, kind = line
    code, mark, more = text.partition(_MARK)
    if not mark:
        yield text
        return
    info = _info_of(path, kind, known)
    comment = comment_of(info, more.strip())
    column = max(COLUMN, len(code) + 2)
    if WIDTH - column - 2 < NARROWEST:
        indent = len(code) - len(code.lstrip())
        room = WIDTH - indent - 2
        yield from (" " * indent + f"# {part}" for part in _wrapped(comment, room))
        yield code
        return
    first, *others = _wrapped(comment, WIDTH - column - 2)
    yield f"{code:<{column}}# {first}"
    yield from (" " * column + f"# {part}" for part in others)


def _info_of(path: tuple[str, ...], kind: str, known: list[KeyInfo]) -> KeyInfo:
    """The key at a path; entries of a dict go by any name."""
    for info in known:
        if info.kind in ("", kind) and _is_at(info, path):
            return info
    raise SpecError(f"a template has the key {'.'.join(path)}, which no file may have")


def _wrapped(comment: str, width: int) -> list[str]:
    return textwrap.wrap(comment, width, break_on_hyphens=False)


def _is_at(info: KeyInfo, path: tuple[str, ...]) -> bool:
    steps = info.path.split(".")
    return len(steps) == len(path) and all(
        step in (given, "<name>") for step, given in zip(steps, path, strict=True)
    )


def example_of(info: KeyInfo) -> str:
    """A line with a key: as `hil new` writes it, else with its default; empty without either."""
    for code, path, kind in _examples():
        if info.kind in ("", kind) and _is_at(info, path):
            return code
    key = info.path.rpartition(".")[2]
    value = info.default.strip("`")
    return f"{key}: {value}" if info.default.startswith("`") else ""


@cache
def _examples() -> tuple[tuple[str, tuple[str, ...], str], ...]:
    """Lines of the templates: without comment and indentation, with path and kind."""
    found = []
    for file in sorted(files("hil.spec").joinpath("templates").iterdir(), key=lambda f: f.name):
        for line, path, kind in _lines(file.read_text("utf-8")):
            code = re.sub(r" +#[ ?].*", "", line).strip().lstrip("#- ")
            if path and "@" not in code and not code.endswith(":"):
                found.append((code, path, kind))
    return tuple(found)
