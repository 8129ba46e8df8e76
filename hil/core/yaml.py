"""YAML text to data: the grammar is PyYAML's, the scalars are those of YAML 1.2.

PyYAML reads YAML 1.1, where `1e-3` is text, `on` is true, `12:30` is 750 and the last of two equal
keys wins without a word. Here the scalars follow the YAML 1.2 core schema (YAML 1.2.2, §10.3.2),
a key given twice is an error, and so is everything a spec has no use for: tags, merge keys,
several documents, and aliases that blow up.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import yaml

from hil.core.errors import SpecError
from hil.core.source import Mark, Problem, Source, refuse, shown
from hil.core.yaml_extent import Extent
from hil.core.yaml_nodes import CORE_SCALARS, TAG, Reading, mark_of

DEEPEST = 40
"""Levels of nesting; a spec has seven."""


class CoreLoader(yaml.SafeLoader):
    """PyYAML's safe loader with the scalars of YAML 1.2 and a limit on depth and size."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own protocol

    def __init__(self, text: str) -> None:
        self._extent = Extent(len(text), DEEPEST)
        super().__init__(text)

    def get_event(self) -> yaml.Event:
        """Return the next event; what is too deep or too much ends here, before it is built."""
        event: yaml.Event = super().get_event()  # type: ignore[no-untyped-call]
        try:
            self._extent.see(event)
        except ValueError as error:
            mark: Any = event.start_mark
            raise yaml.MarkedYAMLError(problem=str(error), problem_mark=mark) from None
        return event


for _name, (_pattern, _first) in CORE_SCALARS.items():
    CoreLoader.add_implicit_resolver(TAG + _name, re.compile(_pattern + r"\Z"), list(_first))


def parse_text(text: str, name: str) -> Source:
    """Parse YAML text; problems that leave the rest readable are collected in the result.

    Raises:
        SpecError: The text is empty or breaks YAML's grammar.
    """
    node = _composed(text.removeprefix("\ufeff"), name)
    source = Source(name)
    if node is None:
        raise refuse([Problem(Mark(name, 1, 1), (), "the file is empty")])
    source.data = Reading(source).value(node, ())
    return source


def scalar(text: str, name: str = "value") -> Any:
    """A value as typed on a command line: `3`, `1e-3`, `on` (text) or `[4, 20, 20]`.

    Args:
        text: YAML; nothing is None.
        name: Begins the message of an error.

    Raises:
        SpecError: It is not YAML.
    """
    if not text.strip():
        return None
    source = parse_text(text, name)
    if source.problems:
        raise refuse(source.problems)
    return source.data


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """Return `name=value` texts as a dict; values are read as YAML scalars.

    Raises:
        SpecError: One is no such text, or its value is not YAML.
    """
    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}


def place_after(before: str, name: str) -> Mark:
    """The place of the character that follows the text `before`."""
    return Mark(name, before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1)


def _composed(text: str, name: str) -> yaml.Node | None:
    try:
        loader = CoreLoader(text)
    except yaml.reader.ReaderError as error:
        message = f"the character U+{int(error.character):04X} is not allowed in YAML"
        raise refuse([Problem(place_after(text[: error.position], name), (), message)]) from None
    try:
        return loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark, message = _plain_words(error)
        if message == _COLON and mark is not None and _is_a_key(text, mark):
            message = "this line is indented differently from the line above"
        raise refuse([Problem(mark_of(mark or loader.get_mark(), name), (), message)]) from None
    # PyYAML lets Python's own errors through for escapes and directives out of range.
    except (ValueError, OverflowError):
        message = "the escape or the number here is out of range"
        raise refuse([Problem(mark_of(loader.get_mark(), name), (), message)]) from None
    finally:
        loader.dispose()


def _plain_words(error: yaml.MarkedYAMLError) -> tuple[yaml.Mark | None, str]:
    """Where the mistake is and what it is, where PyYAML says what its parser had hoped for."""
    told = f"{error.context or ''} {error.problem or ''}"
    for sign, meaning in _AT_THE_START:
        if sign in told:
            return error.context_mark or error.problem_mark, meaning
    meaning = next((meaning for sign, meaning in _AT_THE_END if sign in told), "")
    return error.problem_mark or error.context_mark, meaning or shown(error.problem or "not YAML")


def _is_a_key(text: str, mark: yaml.Mark) -> bool:
    """Whether a ':' is the first of a line that is further in than what the line above begins."""
    lines = text.splitlines()[: mark.line + 1]
    line, above = lines[-1], [one for one in lines[:-1] if one.strip() and one.strip()[0] != "#"]
    if not above or not _KEY.fullmatch(line[: mark.column]):
        return False
    return _indent(line) != _indent(above[-1])


def _indent(line: str) -> int:
    """Column where the text of a line begins, behind the dashes of lists."""
    return len(line) - len(line.lstrip(" -"))


_KEY = re.compile(r" *[\w.-]+ *")
_COLON = "a ':' that does not fit here: quote text that holds ': '"

_AT_THE_START = (
    ("could not find expected ':'", "this is neither a key with ':' nor a value of one"),
    ("found unexpected end of stream", "a quote is opened here and never closed"),
    ("found unexpected document separator", "a quote is opened here and never closed"),
)
"""Mistakes that PyYAML notices long after the place where they were made."""

_AT_THE_END = (
    ("'\\t'", "a tab: YAML is indented with spaces"),
    ("found another document", "a second document: only one per file, remove the '---'"),
    ("mapping values are not allowed", _COLON),
    ("expected <block end>", "this continues nothing that stands above: check the indentation"),
    ("found undefined alias", "the alias refers to an anchor that is not defined above"),
    ("expected ',' or '}'", "a ',' or '}' is missing before this"),
    ("expected ',' or ']'", "a ',' or ']' is missing before this"),
    ("found duplicate anchor", "the anchor is defined a second time"),
    ("expected the node content", "a value is missing here"),
    (
        "expected '<document start>'",
        "this continues nothing that stands above: check the indentation",
    ),
    ("sequence entries are not allowed", "a '-' that does not fit here: quote it or indent it"),
    ("cannot start any token", "text cannot begin with this character: put it in quotes"),
)
