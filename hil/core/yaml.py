"""YAML as plain data: where everything stood in a file, what is wrong with it, and writing it.

No other module reads or writes YAML. Two readers stand on PyYAML's events, nodes and marks:

===========================  ==================================  =================================
reader                       for                                 values and mistakes
===========================  ==================================  =================================
`read_source`, `parse`,      specs, stations, maps, overrides:   YAML 1.2; every mistake at its
`scalar`                     what people write for this tool     line and column, in a `Source`
`look_into`, `with_value`    what others wrote, or what is only  YAML 1.1 as PyYAML has it, in its
                             looked at or passed on              words; compiled where it can be
===========================  ==================================  =================================

PyYAML reads YAML 1.1, where `1e-3` is text, `on` is true, `12:30` is 750 and the last of two equal
keys wins without a word. The first reader takes PyYAML's grammar, the scalars of the YAML 1.2 core
schema (YAML 1.2.2, §10.3.2), and refuses what a spec has no use for: keys given twice, tags, merge
keys and several documents.

Both readers have a limit on depth and size (`_Extent`). It counts events with aliases followed,
before anything is built of them, because aliases make much of little ("billion laughs"): 600 bytes
stand for 10⁹ values. A refusal costs no more than reading that far.

What is written (`yaml_text`, `as_scalar`, `quoted_scalar`) means the same in every version of YAML.
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
"""Larger files are no specs; poses belong into a CSV beside the spec."""

DEEPEST = 40
"""Levels of nesting of what `parse` reads; a spec has seven."""

DEEPEST_LOOK = 100
"""Levels of nesting of what `look_into` reads: a compiled loader has no other end than a crash."""

MOST_PROBLEMS = 50
"""Problems that are written out; the others are counted."""

KeyPath: TypeAlias = tuple[str | int, ...]
"""Keys and list indices from the top of the file to a value."""


class Mark(NamedTuple):
    """A place in a file; line and column count from 1, and are 0 for what is on one line anyway."""

    file: str
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}" if self.line else self.file


class Problem(NamedTuple):
    """One thing that is wrong: where, at which key, and what in plain words."""

    mark: Mark
    path: KeyPath
    message: str

    def __str__(self) -> str:
        path = dotted(self.path)
        return f"{self.mark}: {path}: {self.message}" if path else f"{self.mark}: {self.message}"


@dataclass
class Source:
    """The content of one YAML file as plain data, with the place of every key and value.

    Attributes:
        name: The file as the person named it; begins every message.
        data: dicts, lists, strings, numbers, booleans and None.
        keys: Where each key of a mapping stands.
        values: Where each value begins.
        problems: What was wrong with the YAML itself, although it could be parsed.
    """

    name: str
    data: Any = None
    keys: dict[KeyPath, Mark] = field(default_factory=dict)
    values: dict[KeyPath, Mark] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def mark(self, path: KeyPath, *, key: bool = False) -> Mark:
        """Return the place of a value (or of its key), or of the nearest thing around it."""
        if key and path in self.keys:
            return self.keys[path]
        while path not in self.values and path:
            path = path[:-1]
        return self.values.get(path, Mark(self.name, 1, 1))

    def at(self, path: KeyPath) -> Any:
        """Return the value at a path, None where there is nothing."""
        value = self.data
        for step in path:
            try:
                value = value[step]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def add(self, path: KeyPath, message: str, *, key: bool = False) -> None:
        """Note a problem with the value (or the key) at `path`."""
        self.problems.append(Problem(self.mark(path, key=key), path, message))

    def replaced(self, path: KeyPath, name: str) -> None:
        """Note that the value at `path` was replaced by one from `name`, such as `--set 1`.

        Nothing in the new value has a place of its own, nor have mappings that were made for it.
        """
        for places in (self.keys, self.values):
            for below in [p for p in places if p[: len(path)] == path]:
                del places[below]
            for n in range(1, len(path) + 1):
                places.setdefault(path[:n], Mark(name, 0, 0))


def refuse(problems: list[Problem], hint: str = "", more: int = 0) -> SpecError:
    """Return the error that lists problems in the order of the file.

    Args:
        problems: In any order.
        hint: Of the error.
        more: So many problems were not even explained.
    """
    ordered = sorted(set(problems), key=lambda p: (p.mark, dotted(p.path), p.message))
    lines = [str(problem) for problem in ordered[:MOST_PROBLEMS]]
    if (left := len(ordered) - len(lines) + more) > 0:
        lines.append(f"… and {left} more")
    return SpecError("\n".join(lines), hint=hint)


def dotted(path: KeyPath) -> str:
    """Return a path as people write it: `loads.1.mass_kg`."""
    return ".".join(shown(str(step)) for step in path)


def read_source(path: str | FilePath, kind: str = "") -> Source:
    """Read and parse one file.

    Args:
        path: The file.
        kind: Key that such files begin with, so that only such are suggested for one not there.

    Raises:
        SpecError: It is missing, unreadable, too large, not UTF-8 or not YAML.
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
            hint="see whether it exists and may be read",
        ) from None
    return parse(raw, str(path))


def _is(file: FilePath, kind: str) -> bool:
    """Return whether a file has the key of its kind, as far as its beginning shows."""
    with file.open("rb") as stream:
        lines = stream.read(20_000).split(b"\n")
    return any(line.startswith(f"{kind}:".encode()) for line in lines)


def parse(raw: bytes | str, name: str) -> Source:
    """Parse YAML text; problems that leave the rest readable are collected in the result.

    Raises:
        SpecError: The text is too large, not UTF-8, empty, or breaks YAML's grammar.
    """
    if len(raw) > MOST_BYTES:
        raise SpecError(
            f"{name}: is larger than {MOST_BYTES // 1024} KiB, which no spec is",
            hint="keep long lists of poses in a CSV file and name it under `excitation.file`",
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
    """Return a value typed on a command line: `3`, `1e-3`, `on` (text) or `[4, 20, 20]`.

    Args:
        text: YAML; nothing is None.
        name: Begins the message of an error.

    Raises:
        SpecError: It is not YAML.
    """
    if not text.strip():
        return None
    source = parse(text, name)
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


def is_number(text: str) -> bool:
    """Return whether a text would be a number if it stood in YAML without quotes."""
    return re.fullmatch(_CORE_SCALARS["float"][0], text) is not None


def look_into(text: str | bytes) -> Any:
    """Return the data of a document that is only looked at, without places.

    PyYAML's compiled loader reads it where there is one: 13 ms for a station of a hundred robots,
    not 60.

    Raises:
        ValueError: It is not YAML, not UTF-8, nested too deeply, or blown up by aliases.
    """
    with _one_kind_of_error():
        _require_bounded(text)
        return yaml.load(text, _quick_loader())  # noqa: S506 - a safe loader


def with_value(text: str, key: str, value: str) -> str | None:
    """Return a document with another value for a key at its top; all else stays as written.

    Args:
        text: YAML.
        key: Whose value is no list or mapping.
        value: YAML, on one line.

    Returns:
        None where there is no such key with such a value.

    Raises:
        ValueError: It is not YAML, nested too deeply, or blown up by aliases.
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
        data: dicts, lists, strings, numbers, booleans and None.
        block: Every value on a line of its own, and quotes only where a version of YAML needs them.
            Otherwise innermost lists and mappings take one line, and only words have no quotes.
        width: Characters of a line.
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
    """Quotes text that YAML 1.2 takes for something else, as PyYAML does for YAML 1.1.

    Line breaks of Unicode, which PyYAML would write as they are, are escaped.
    """


class _FlowDumper(yaml.SafeDumper):
    """Quotes all text but words."""


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
    """Return a text as YAML on one line: without quotes where every reader takes it for text."""
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
    """Return the compiled loader where PyYAML was built with one."""
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _require_bounded(text: str | bytes) -> None:
    """Raise if a document is too deep or too much to be built.

    A compiled loader builds without asking, so the events are read once more before.
    """
    extent = _Extent(len(text), DEEPEST_LOOK)
    for event in yaml.parse(text, _quick_loader()):
        extent.see(event)


@contextmanager
def _one_kind_of_error() -> Iterator[None]:
    """Turn whatever PyYAML raises into a ValueError: of `!!int ""` comes an IndexError."""
    try:
        yield
    except Exception as error:
        # PyYAML's own errors say where; others say little of what it tripped over.
        plain = type(error) is ValueError or hasattr(error, "problem")
        message = str(error) if plain else f"{type(error).__name__}: {error}"
        raise ValueError(f"no YAML: {message}") from error


# Limits


_MOST_FREE = 10_000
"""Values that a document may hold however short it is."""

_MOST_PER_CHARACTER = 2
"""Values a character: written out, a value takes one at least; the rest is behind aliases."""

_MOST_VALUES = 2**19
"""Values of any document."""

_MOST_CHARACTERS = 2**19
"""Characters of values that aliases may add to those of the text."""


class _Open:
    """A list or mapping that has not ended, and the counts before it began."""

    __slots__ = ("anchor", "characters", "levels", "values")

    def __init__(self, anchor: str | None, values: int, characters: int) -> None:
        self.anchor = anchor
        self.values = values
        self.characters = characters
        self.levels = 1


class _Extent:
    """Depth and size of a document, with its aliases followed, as far as its events were seen.

    Args:
        length: Characters of the text.
        deepest: Most levels of nesting.
    """

    def __init__(self, length: int, deepest: int) -> None:
        self._deepest = deepest
        self._most_values = min(_MOST_FREE + _MOST_PER_CHARACTER * length, _MOST_VALUES)
        self._most_characters = _MOST_CHARACTERS + length
        self._values = 0
        self._characters = 0
        self._open: list[_Open] = []
        # Levels, values and characters; None while the anchor's list or mapping has not ended.
        self._anchors: dict[str | None, tuple[int, int, int] | None] = {}

    def see(self, event: yaml.Event) -> None:
        """Count an event of the parser.

        Raises:
            ValueError: The document is nested too deeply, or its aliases expand to too much.
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
            # An anchor that is not defined is an error of the reader itself.
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
            raise ValueError("aliases expand to more values than a file of this size may hold")
        self._reach(levels)

    def _reach(self, levels: int) -> None:
        """Note how deep something is that stands in the innermost open list or mapping."""
        if self._open and self._open[-1].levels <= levels:
            self._open[-1].levels = levels + 1


# Grammar: from text to PyYAML's nodes, and what PyYAML says of mistakes in plain words


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
"""Pattern and possible first characters of the plain scalars of YAML 1.2 that are not text."""


class _CoreLoader(yaml.SafeLoader):
    """PyYAML's safe loader with the scalars of YAML 1.2 and a limit on depth and size."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own protocol

    def __init__(self, text: str) -> None:
        self._extent = _Extent(len(text), DEEPEST)
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


for _name, (_pattern, _first) in _CORE_SCALARS.items():
    _CoreLoader.add_implicit_resolver(_TAG + _name, re.compile(_pattern + r"\Z"), list(_first))


def _composed(text: str, name: str) -> yaml.Node | None:
    """Return the document as PyYAML's nodes, None where the text holds nothing."""
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
    # PyYAML lets Python's own errors through for escapes and directives out of range.
    except (ValueError, OverflowError):
        message = "the escape or the number here is out of range"
        raise refuse([Problem(_mark(loader.get_mark(), name), (), message)]) from None
    finally:
        loader.dispose()


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
"""Mistakes that PyYAML notices where they were made."""


def _plain_words(error: yaml.MarkedYAMLError, text: str) -> tuple[yaml.Mark | None, str]:
    """Return where the mistake is and what it is: PyYAML says what its parser had hoped for."""
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
    """Return whether a ':' ends a key that is indented unlike what the line above begins."""
    lines = text.splitlines()[: mark.line + 1]
    line, above = lines[-1], [one for one in lines[:-1] if one.strip() and one.strip()[0] != "#"]
    if not above or not re.fullmatch(r" *[\w.-]+ *", line[: mark.column]):
        return False
    # Behind the dashes of lists.
    column, column_above = (len(one) - len(one.lstrip(" -")) for one in (line, above[-1]))
    return column != column_above


def _mark(mark: yaml.Mark, name: str) -> Mark:
    """Return PyYAML's mark, counted from 1."""
    return Mark(name, mark.line + 1, mark.column + 1)


def _mark_after(before: str, name: str) -> Mark:
    """Return the place of the character that follows the text `before`."""
    return Mark(name, before.count("\n") + 1, len(before) - before.rfind("\n"))


# Values: from nodes to plain data. What is wrong is noted in the source and the walk goes on, so
# that one reading reports everything.


_LARGEST_INTEGER = 2**63 - 1


def _value(node: yaml.Node, path: KeyPath, source: Source) -> Any:
    """Return the data of a node that stands at `path`."""
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
            message = f"is given twice, first at line {first.line}, column {first.column}"
            source.problems.append(Problem(mark, (*path, key), message))
        else:
            source.keys[*path, key] = mark
            result[key] = _value(value_node, (*path, key), source)
    return result


def _why_no_key(node: yaml.Node) -> str:
    """Return why a node cannot be the key of a mapping, nothing where it can."""
    if not isinstance(node, yaml.ScalarNode):
        return "a list or mapping cannot be a key"
    if node.value == "<<":
        return "merge keys (<<) are not part of YAML 1.2: write the keys out"
    if node.tag != _TAG + "str":
        comma = "; decimals take a point, not a comma" if node.tag == _TAG + "int" else ""
        return f"the key '{shown(node.value)}' is no text: put it in quotes{comma}"
    if _has_half_character(node.value):
        return "the key holds half a character (a lone surrogate)"
    return ""


def _scalar(node: yaml.ScalarNode, path: KeyPath, source: Source) -> Any:
    """Return what a text, number, boolean or null says."""
    kind, text = node.tag.removeprefix(_TAG), node.value
    if kind == "str":
        if _has_half_character(text):
            source.add(path, "the text holds half a character (a lone surrogate)")
        return text
    if kind not in _CORE_SCALARS:
        message = f"the tag {_tag(node)} is not allowed: a spec is plain data"
    elif not re.fullmatch(_CORE_SCALARS[kind][0], text):
        message = f"{shown(text)} is no {kind}, as its tag says"
    elif kind == "int":
        base = {"0o": 8, "0x": 16}.get(text[:2], 10)
        # Python refuses to convert thousands of digits; so many are too large in any case.
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
    """Whether UTF-8 cannot hold it; U+DC80 to U+DCFF stand for bytes of names (`hil.core.text`)."""
    return any("\ud800" <= c <= "\udfff" and not "\udc80" <= c <= "\udcff" for c in text)


def _tag(node: yaml.Node) -> str:
    return shown(str(node.tag).replace(_TAG, "!!"))
