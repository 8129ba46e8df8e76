"""YAML as plain data: reading with positions and error messages, and writing.

All other modules read and write YAML through this module. Two readers of this module use the
events, nodes and marks of PyYAML:

===========================  ==================================  =================================
reader                       use                                 result
===========================  ==================================  =================================
`read_source`, `parse`,      files that users write for `hil`:   YAML 1.2; errors with line and
`scalar`                     specs, stations, maps, overrides    column, in a `Source`
`look_into`, `with_value`    files of other programs, and files  YAML 1.1 and errors of PyYAML;
                             that are only searched or copied    compiled loader if available
===========================  ==================================  =================================

PyYAML reads YAML 1.1, in which `1e-3` is text, `on` is true, `12:30` is 750 and, of two equal keys,
the last one wins silently. `read_source`, `parse` and `scalar` use the grammar of PyYAML with the
scalars of the YAML 1.2 core schema (YAML 1.2.2, §10.3.2). The functions `read_source`, `parse` and
`scalar` refuse YAML features that specs do not need: duplicate keys, tags, merge keys and several
documents.

The two readers limit the depth and the size of a document (`_Extent`). The size limit counts events
with all aliases expanded, before any data are built, because aliases can expand a small file
enormously ("billion laughs"): 600 bytes can represent 10⁹ values. The refusal of a document takes
no longer than reading the document up to the limit.

YAML written by this module (`yaml_text`, `as_scalar`, `quoted_scalar`) has the same meaning in
every YAML version.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, NamedTuple, TypeAlias

import yaml

from hil.core.errors import SpecError
from hil.core.suggest import neighbour_of
from hil.core.text import shown

MOST_BYTES = 256 * 1024
"""Maximum size of a YAML file [bytes]; a large set of poses belongs into a CSV file beside the
spec."""

DEEPEST = 40
"""Maximum nesting depth of a document for `parse`; a spec has a depth of seven."""

DEEPEST_LOOK = 100
"""Maximum nesting depth of a document for `look_into`, whose compiled loader would crash at
large depths."""

MOST_PROBLEMS = 50
"""Maximum number of problems that a message lists; the remaining problems are only counted."""

KeyPath: TypeAlias = tuple[str | int, ...]
"""Keys and list indices from the top of the file to a value."""


class Mark(NamedTuple):
    """Position in a file; line and column count from 1, and are 0 for a text of only one line."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


class Problem(NamedTuple):
    """Problem in a file: position, key path and plain description."""

    mark: Mark
    path: KeyPath
    message: str

    def __str__(self) -> str:
        path = dotted(self.path)
        return f"{self.mark}: {path}: {self.message}" if path else f"{self.mark}: {self.message}"


@dataclass
class Source:
    """Content of one YAML file as plain data, with the position of every key and value.

    Attributes:
        name: File name as passed by the user, with which every message begins.
        data: Content of the file as dicts, lists, strings, numbers, booleans and None.
        keys: Position of each key of a mapping, by path.
        values: Position of the beginning of each value, by path.
        problems: List of the problems in the YAML text that did not prevent parsing.
    """

    name: str
    data: Any = None
    keys: dict[KeyPath, Mark] = field(default_factory=dict)
    values: dict[KeyPath, Mark] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def mark(self, path: KeyPath, *, key: bool = False) -> Mark:
        """Return the position of a value (or of its key), or of the nearest enclosing value."""
        if key and path in self.keys:
            return self.keys[path]
        while path not in self.values and path:
            path = path[:-1]
        return self.values.get(path, Mark(self.name, 1, 1))

    def at(self, path: KeyPath) -> Any:
        """Return the value at a path; None if there is no value at this path."""
        value = self.data
        for step in path:
            try:
                value = value[step]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def add(self, path: KeyPath, message: str, *, key: bool = False) -> None:
        """Add a problem that concerns the value (or the key) at `path`."""
        self.problems.append(Problem(self.mark(path, key=key), path, message))

    def replaced(self, path: KeyPath, name: str) -> None:
        """Record that the value at `path` was replaced by a value from `name`, such as `--set 1`.

        The parts of the new value have no positions, and mappings that were created for the new
        value have no positions either.
        """
        for places in (self.keys, self.values):
            for below in [p for p in places if p[: len(path)] == path]:
                del places[below]
            for n in range(1, len(path) + 1):
                places.setdefault(path[:n], Mark(name, 0, 0))


def refuse(problems: list[Problem], hint: str = "", more: int = 0) -> SpecError:
    """Return the error that lists problems in the order of their positions in the file.

    Args:
        problems: List of problems, in any order.
        hint: Hint of the returned error.
        more: Number of additional problems that are not in the list.
    """
    ordered = sorted(set(problems), key=lambda p: (p.mark, dotted(p.path), p.message))
    lines = [str(problem) for problem in ordered[:MOST_PROBLEMS]]
    if (left := len(ordered) - len(lines) + more) > 0:
        lines.append(f"… and {left} more")
    return SpecError("\n".join(lines), hint=hint)


def dotted(path: KeyPath) -> str:
    """Return a path in dotted notation: `loads.1.mass_kg`."""
    return ".".join(shown(str(step)) for step in path)


def read_source(path: str | FilePath, kind: str = "") -> Source:
    """Read and parse a YAML file.

    Args:
        path: YAML file.
        kind: Key with which files of the expected kind begin; if the file is missing, only files
            with this key are suggested.

    Raises:
        SpecError: The file is missing, unreadable, too large, not UTF-8 or not YAML.
    """
    file = FilePath(path)
    try:
        with file.open("rb") as stream:
            raw = stream.read(MOST_BYTES + 1)
    except FileNotFoundError:
        where = "" if file.is_absolute() else f" in {FilePath.cwd()}"
        raise SpecError(
            f"{path}: there is no such file{where}",
            hint=neighbour_of(file, (".yaml", ".yml"), lambda p: not kind or _is(p, kind)),
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise SpecError(
            f"{shown(str(path), most=300)}: cannot be read: {reason}",
            hint="check that the file exists and is readable",
        ) from None
    return parse(raw, str(path))


def _is(file: FilePath, kind: str) -> bool:
    """Return whether a file has the key of its kind in its first 20 000 bytes."""
    with file.open("rb") as stream:
        lines = stream.read(20_000).split(b"\n")
    return any(line.startswith(f"{kind}:".encode()) for line in lines)


def parse(raw: bytes | str, name: str) -> Source:
    """Parse YAML text; problems that do not prevent parsing are collected in the result.

    Raises:
        SpecError: The text is too large, not UTF-8, empty, or violates the grammar of YAML.
    """
    if len(raw) > MOST_BYTES:
        raise SpecError(
            f"{name}: is larger than {MOST_BYTES // 1024} KiB, the limit for such files",
            hint="move long lists of poses to a CSV file and name it under `excitation.file`",
        )
    try:
        text = raw.decode("utf-8") if isinstance(raw, bytes) else raw
    except UnicodeDecodeError as error:
        message = f"byte 0x{error.object[error.start]:02x} is not UTF-8: save the file as UTF-8"
        before = error.object[: error.start].decode("utf-8")
        raise refuse([Problem(_mark_after(before, name), (), message)]) from None
    node = _composed(text.removeprefix("\ufeff"), name)
    if node is None:
        raise refuse([Problem(Mark(name, 1, 1), (), "the file is empty")])
    source = Source(name)
    source.data = _value(node, (), source)
    return source


def scalar(text: str, name: str = "value") -> Any:
    """Return the value of a command-line argument: `3`, `1e-3`, `on` (text) or `[4, 20, 20]`.

    Args:
        text: YAML text of the value; an empty text gives None.
        name: Beginning of the error message, such as the name of the option.

    Raises:
        SpecError: The text is not YAML.
    """
    if not text.strip():
        return None
    source = parse(text, name)
    if source.problems:
        raise refuse(source.problems)
    return source.data


def parse_parameters(texts: Iterable[str]) -> dict[str, Any]:
    """Return texts of the form `name=value` as a dict; the values are read as YAML scalars.

    Raises:
        SpecError: A text does not have the form `name=value`, or its value is not YAML.
    """
    pairs = [text.partition("=") for text in texts]
    for name, equals, _ in pairs:
        if not (name and equals):
            raise SpecError(f"--set {name!r} is not NAME=VALUE", hint="for example: --set seed=3")
    return {name: scalar(value) for name, _, value in pairs}


def is_number(text: str) -> bool:
    """Return whether YAML would read a text without quotes as a number."""
    return re.fullmatch(_CORE_SCALARS["float"][0], text) is not None


def look_into(text: str | bytes) -> Any:
    """Return the data of a YAML document, without the positions of the values.

    The compiled loader of PyYAML is used if it is installed: the compiled loader needs 13 ms
    instead of 60 ms for a station with a hundred robots.

    Raises:
        ValueError: The text is not YAML, not UTF-8, nested too deeply, or too large with its
            aliases expanded.
    """
    with _one_kind_of_error():
        _require_bounded(text)
        return yaml.load(text, _quick_loader())  # noqa: S506 - a safe loader


def with_value(text: str, key: str, value: str) -> str | None:
    """Return a document with a different value for a top-level key, otherwise unchanged.

    Args:
        text: YAML document.
        key: Top-level key whose value is neither a list nor a mapping.
        value: New value of the key as YAML text on one line.

    Returns:
        Changed document; None if the document has no such key with a scalar value.

    Raises:
        ValueError: The text is not YAML, nested too deeply, or too large with its aliases expanded.
    """
    with _one_kind_of_error():
        _require_bounded(text)
    try:
        document = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from error
    for key_node, node in document.value if isinstance(document, yaml.MappingNode) else ():
        if key_node.value == key and isinstance(node, yaml.ScalarNode):
            return text[: node.start_mark.index] + value + text[node.end_mark.index :]
    return None


def yaml_text(data: Any, *, block: bool = False, width: int = 80) -> str:
    """Return plain data as a YAML document.

    Args:
        data: Content of the document as dicts, lists, strings, numbers, booleans and None.
        block: Whether every value is on a separate line, with quotes only if a YAML version needs
            them. If `block` is false, innermost lists and mappings are on one line, and only words
            are unquoted.
        width: Maximum number of characters in a line of the document.
    """
    text: str = yaml.dump(
        data,
        Dumper=_BlockDumper if block else _FlowDumper,
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=False if block else None,
        width=width,
    )
    return text


class _BlockDumper(yaml.SafeDumper):
    """YAML dumper that quotes text that YAML 1.1 or YAML 1.2 would read as a different type.

    Unicode line breaks, which PyYAML would write unchanged, are escaped.
    """


class _FlowDumper(yaml.SafeDumper):
    """YAML dumper that quotes all text except plain words."""


_WORDS = re.compile(r"[A-Za-z][A-Za-z_-]+[0-9]*")
_CONSTANTS = ("null", "true", "false", "yes", "no", "on", "off")


def _block_text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    is_other = any(re.fullmatch(pattern, value) for pattern, _ in _CORE_SCALARS.values())
    style = "'" if is_other else None if value.isprintable() else '"'
    return dumper.represent_scalar(_TAG + "str", value, style=style)


def _flow_text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    is_word = _WORDS.fullmatch(value) and value.casefold() not in _CONSTANTS
    return dumper.represent_scalar(_TAG + "str", value, style=None if is_word else '"')


_BlockDumper.add_representer(str, _block_text)
_FlowDumper.add_representer(str, _flow_text)


def as_scalar(text: str) -> str:
    """Return a text as YAML on one line, without quotes if every reader reads it as text."""
    try:
        line = {"k": text}
        if look_into(f"k: {text}") == line == parse(f"k: {text}", "").data:
            return text
    except (ValueError, SpecError):
        pass
    return quoted_scalar(text)


def quoted_scalar(text: str) -> str:
    """Return a text as YAML on one line in double quotes."""
    line: str = yaml.safe_dump(text, default_style='"', width=float("inf"), allow_unicode=True)
    return line.rstrip("\n")


def _quick_loader() -> Any:
    """Return the compiled loader of PyYAML; the Python loader if the compiled loader is missing."""
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _require_bounded(text: str | bytes) -> None:
    """Raise if a YAML document is nested too deeply or is too large.

    The compiled loader does not limit depth and size, so the events of the document are read in
    advance.
    """
    extent = _Extent(len(text), DEEPEST_LOOK)
    for event in yaml.parse(text, _quick_loader()):
        extent.see(event)


@contextmanager
def _one_kind_of_error() -> Iterator[None]:
    """Convert every error of PyYAML to a ValueError.

    For example, PyYAML raises an IndexError for `!!int ""`.
    """
    try:
        yield
    except Exception as error:
        # Errors of PyYAML contain their position; other errors are prefixed with their type.
        plain = type(error) is ValueError or hasattr(error, "problem")
        message = str(error) if plain else f"{type(error).__name__}: {error}"
        raise ValueError(f"not YAML: {message}") from error


# Limits


_MOST_FREE = 10_000
"""Number of values that any YAML document may contain, regardless of its length."""

_MOST_PER_CHARACTER = 2
"""Number of additional values that a YAML document may contain per character.

Without aliases, each value needs at least one character; the remaining values are allowed for
aliases.
"""

_MOST_VALUES = 2**19
"""Maximum number of values in any YAML document, with aliases expanded."""

_MOST_CHARACTERS = 2**19
"""Maximum number of characters that aliases may add to the characters of the text."""


class _Open:
    """List or mapping whose end event is pending, with the counts before its start."""

    __slots__ = ("anchor", "characters", "levels", "values")

    def __init__(self, anchor: str | None, values: int, characters: int) -> None:
        self.anchor = anchor
        self.values = values
        self.characters = characters
        self.levels = 1


class _Extent:
    """Depth and size of a document with its aliases expanded, up to the present event.

    Args:
        length: Number of characters of the YAML text.
        deepest: Maximum nesting depth of the document.
    """

    def __init__(self, length: int, deepest: int) -> None:
        self._deepest = deepest
        self._most_values = min(_MOST_FREE + _MOST_PER_CHARACTER * length, _MOST_VALUES)
        self._most_characters = _MOST_CHARACTERS + length
        self._values = 0
        self._characters = 0
        self._open: list[_Open] = []
        # Levels, values and characters of each anchor; None while its list or mapping is open.
        self._anchors: dict[str | None, tuple[int, int, int] | None] = {}

    def see(self, event: yaml.Event) -> None:
        """Count an event of the parser, and check the limits of the document.

        Raises:
            ValueError: The document is nested too deeply, or its aliases expand to too many values.
        """
        if isinstance(event, yaml.ScalarEvent):
            length = len(event.value)
            if event.anchor is not None:
                self._anchors[event.anchor] = (0, 1, length)
            self._add(0, 1, length)
        elif isinstance(event, yaml.CollectionStartEvent):
            opened = _Open(event.anchor, self._values, self._characters)
            self._add(1, 1, 0)
            self._open.append(opened)
            if event.anchor is not None:
                self._anchors[event.anchor] = None
        elif isinstance(event, yaml.CollectionEndEvent):
            ended = self._open.pop()
            if ended.anchor is not None:
                values = self._values - ended.values
                characters = self._characters - ended.characters
                self._anchors[ended.anchor] = (ended.levels, values, characters)
            self._reach(ended.levels)
        elif isinstance(event, yaml.AliasEvent):
            # The reader itself reports an undefined anchor.
            again = self._anchors.get(event.anchor, (0, 1, 0))
            if again is None:
                raise ValueError("an alias contains itself")
            self._add(*again)

    def _add(self, levels: int, values: int, characters: int) -> None:
        self._values += values
        self._characters += characters
        if len(self._open) + levels > self._deepest:
            raise ValueError(f"more than {self._deepest} levels")
        if self._values > self._most_values or self._characters > self._most_characters:
            raise ValueError("aliases expand to more values than a file of this size may contain")
        self._reach(levels)

    def _reach(self, levels: int) -> None:
        """Update the depth of the innermost open list or mapping."""
        if self._open and self._open[-1].levels <= levels:
            self._open[-1].levels = levels + 1


# Grammar: from text to PyYAML nodes, with error messages of PyYAML in plain words


_TAG = "tag:yaml.org,2002:"

_CORE_SCALARS = {
    "null": (r"(?:~|null|Null|NULL|)", ("~", "n", "N", "")),
    "bool": (r"(?:true|True|TRUE|false|False|FALSE)", tuple("tTfF")),
    "int": (r"(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)", tuple("-+0123456789")),
    "float": (
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))",
        tuple("-+.0123456789"),
    ),
}
"""Pattern and possible first characters of the YAML 1.2 plain scalars that are not text."""


class _CoreLoader(yaml.SafeLoader):
    """Safe loader of PyYAML with the scalars of YAML 1.2 and limits on depth and size."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own protocol

    def __init__(self, text: str) -> None:
        self._extent = _Extent(len(text), DEEPEST)
        super().__init__(text)

    def get_event(self) -> yaml.Event:
        """Return the next event; raise if the YAML document exceeds its limits.

        The limits of a document are checked before any data are constructed.
        """
        event: yaml.Event = super().get_event()  # type: ignore[no-untyped-call]
        try:
            self._extent.see(event)
        except ValueError as error:
            mark: Any = event.start_mark
            raise yaml.MarkedYAMLError(problem=str(error), problem_mark=mark) from None
        return event


for _name, (_pattern, _first) in _CORE_SCALARS.items():
    _CoreLoader.add_implicit_resolver(_TAG + _name, re.compile(_pattern + r"\Z"), list(_first))


def _composed(text: str, name: str) -> yaml.Node | None:
    """Return the YAML document as PyYAML nodes; None if the text is empty."""
    try:
        loader = _CoreLoader(text)
    except yaml.reader.ReaderError as error:
        message = f"the character U+{int(error.character):04X} is not allowed in YAML"
        mark = _mark_after(text[: error.position], name)
        raise refuse([Problem(mark, (), message)]) from None
    try:
        return loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        place, message = _plain_words(error, text)
        raise refuse([Problem(_mark(place or loader.get_mark(), name), (), message)]) from None
    # PyYAML does not catch these errors of Python for escapes and directives out of range.
    except (ValueError, OverflowError):
        message = "the escape or the number here is out of range"
        raise refuse([Problem(_mark(loader.get_mark(), name), (), message)]) from None
    finally:
        loader.dispose()


_COLON = "unexpected ':': put text that contains ': ' in quotes"

_AT_THE_START = (
    ("could not find expected ':'", "this is neither a key with ':' nor the value of a key"),
    ("found unexpected end of stream", "a quotation mark is opened here and never closed"),
    ("found unexpected document separator", "a quotation mark is opened here and never closed"),
)
"""Errors that PyYAML detects long after their position in the text."""

_AT_THE_END = (
    ("'\\t'", "unexpected tab: indent YAML with spaces"),
    ("found another document", "second document: write only one per file and remove the '---'"),
    ("mapping values are not allowed", _COLON),
    ("expected <block end>", "this continues no entry above: check the indentation"),
    ("found undefined alias", "the alias refers to an anchor that is not defined above"),
    ("expected ',' or '}'", "a ',' or '}' is missing before this"),
    ("expected ',' or ']'", "a ',' or ']' is missing before this"),
    ("found duplicate anchor", "the anchor is defined a second time"),
    ("expected the node content", "a value is missing here"),
    (
        "expected '<document start>'",
        "this continues no entry above: check the indentation",
    ),
    ("sequence entries are not allowed", "unexpected '-': quote it or indent it"),
    ("cannot start any token", "text cannot begin with this character: put it in quotes"),
)
"""Errors that PyYAML detects at their position in the text."""


def _plain_words(error: yaml.MarkedYAMLError, text: str) -> tuple[yaml.Mark | None, str]:
    """Return position and plain description of a YAML error, not what the parser expected."""
    words = f"{error.context or ''} {error.problem or ''}"
    for sign, meaning in _AT_THE_START:
        if sign in words:
            return error.context_mark or error.problem_mark, meaning
    mark = error.problem_mark or error.context_mark
    for sign, meaning in _AT_THE_END:
        if sign in words:
            if meaning == _COLON and mark is not None and _is_indented_key(text, mark):
                return mark, "this line is indented differently from the line above"
            return mark, meaning
    return mark, shown(error.problem or "not YAML")


def _is_indented_key(text: str, mark: yaml.Mark) -> bool:
    """Return whether a ':' ends a key whose indentation differs from the line above."""
    lines = text.splitlines()[: mark.line + 1]
    line, above = lines[-1], [one for one in lines[:-1] if one.strip() and one.strip()[0] != "#"]
    if not above or not re.fullmatch(r" *[\w.-]+ *", line[: mark.column]):
        return False
    # The columns start after the dashes of list items.
    column, column_above = (len(one) - len(one.lstrip(" -")) for one in (line, above[-1]))
    return column != column_above


def _mark(mark: yaml.Mark, name: str) -> Mark:
    """Return a PyYAML mark with line and column counted from 1."""
    return Mark(name, mark.line + 1, mark.column + 1)


def _mark_after(before: str, name: str) -> Mark:
    """Return the position of the character that follows the text `before`."""
    return Mark(name, before.count("\n") + 1, len(before) - before.rfind("\n"))


# Values: from nodes to plain data. Problems are added to the source and the conversion continues,
# so that one pass reports all problems.


_LARGEST_INTEGER = 2**63 - 1


def _value(node: yaml.Node, path: KeyPath, source: Source) -> Any:
    """Return the data of the YAML node at `path`."""
    source.values[path] = _mark(node.start_mark, source.name)
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node, path, source)
    is_mapping = isinstance(node, yaml.MappingNode)
    if node.tag != _TAG + ("map" if is_mapping else "seq"):
        source.add(path, f"the tag {_tag(node)} is not allowed: a spec is plain data")
        return None
    if not is_mapping:
        return [_value(item, (*path, i), source) for i, item in enumerate(node.value)]
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key, mark = key_node.value, _mark(key_node.start_mark, source.name)
        if why := _why_no_key(key_node):
            source.problems.append(Problem(mark, path, why))
        elif key in result:
            first = source.keys[*path, key]
            message = f"occurs twice, first at line {first.line}, column {first.column}"
            source.problems.append(Problem(mark, (*path, key), message))
        else:
            source.keys[*path, key] = mark
            result[key] = _value(value_node, (*path, key), source)
    return result


def _why_no_key(node: yaml.Node) -> str:
    """Return the reason why a node cannot be the key of a mapping; empty if it can."""
    if not isinstance(node, yaml.ScalarNode):
        return "a list or mapping cannot be a key"
    if node.value == "<<":
        return "merge keys (<<) are not part of YAML 1.2: write the keys out"
    if node.tag != _TAG + "str":
        comma = "; write a decimal point, not a comma" if node.tag == _TAG + "int" else ""
        return f"the key '{shown(node.value)}' is not text: put it in quotes{comma}"
    if _has_half_character(node.value):
        return "the key contains half a character (a lone surrogate)"
    return ""


def _scalar(node: yaml.ScalarNode, path: KeyPath, source: Source) -> Any:
    """Return the value of a node that is a text, number, boolean or null."""
    kind, text = node.tag.removeprefix(_TAG), node.value
    if kind == "str":
        if _has_half_character(text):
            source.add(path, "the text contains half a character (a lone surrogate)")
        return text
    if kind not in _CORE_SCALARS:
        message = f"the tag {_tag(node)} is not allowed: a spec is plain data"
    elif not re.fullmatch(_CORE_SCALARS[kind][0], text):
        message = f"{shown(text)} is not of type {kind}, which its tag states"
    elif kind == "int":
        base = {"0o": 8, "0x": 16}.get(text[:2], 10)
        # Python refuses to convert thousands of digits; such a number is too large anyway.
        if len(text) < 64 and abs(number := int(text, base)) <= _LARGEST_INTEGER:
            return number
        message = "the number is too large"
    elif kind == "float":
        return float(text.casefold().replace(".inf", "inf").replace(".nan", "nan"))
    else:
        return text.casefold() == "true" if kind == "bool" else None
    source.add(path, message)
    return None


def _has_half_character(text: str) -> bool:
    """Return whether a text contains characters that UTF-8 cannot encode.

    The characters U+DC80 to U+DCFF represent bytes of file names (`hil.core.text`) and are allowed.
    """
    return any("\ud800" <= c <= "\udfff" and not "\udc80" <= c <= "\udcff" for c in text)


def _tag(node: yaml.Node) -> str:
    return shown(str(node.tag).replace(_TAG, "!!"))
