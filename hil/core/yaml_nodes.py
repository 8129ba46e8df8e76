"""From YAML nodes to plain data by the core schema of YAML 1.2, with places and problems.

One rule per kind of node; what is wrong is noted in the `Source` and the walk goes on, so that one
reading reports everything.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from hil.core.source import KeyPath, Mark, Problem, Source, shown

MOST_BYTES = 256 * 1024
"""Larger files are no specs; poses belong into a CSV beside the spec."""

LARGEST_INTEGER = 2**63 - 1

TAG = "tag:yaml.org,2002:"

CORE_SCALARS = {
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


class Reading:
    """One walk over the node tree: builds data, places and problems."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def value(self, node: yaml.Node, path: KeyPath) -> Any:
        """Return the data below a node that stands at `path`."""
        self.source.values[path] = mark_of(node.start_mark, self.source.name)
        if not isinstance(node, yaml.ScalarNode):
            return self._collection(node, path)
        return self._scalar(node, path)

    def _collection(self, node: yaml.Node, path: KeyPath) -> Any:
        is_map = isinstance(node, yaml.MappingNode)
        if node.tag != TAG + ("map" if is_map else "seq"):
            self.source.add(path, f"the tag {_tag(node)} is not allowed: a spec is plain data")
            return None
        return self._mapping(node, path) if is_map else self._sequence(node, path)

    def _sequence(self, node: yaml.Node, path: KeyPath) -> list[Any]:
        return [self.value(item, (*path, i)) for i, item in enumerate(node.value)]

    def _mapping(self, node: yaml.Node, path: KeyPath) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = self._key(key_node, path)
            if key is not None and self._is_new(key, key_node, path, result):
                self.source.keys[*path, key] = mark_of(key_node.start_mark, self.source.name)
                result[key] = self.value(value_node, (*path, key))
        return result

    def _key(self, node: yaml.Node, path: KeyPath) -> str | None:
        mark = mark_of(node.start_mark, self.source.name)
        if not isinstance(node, yaml.ScalarNode):
            message = "a list or mapping cannot be a key"
        elif node.value == "<<":
            message = "merge keys (<<) are not part of YAML 1.2: write the keys out"
        elif node.tag != TAG + "str":
            comma = "; decimals take a point, not a comma" if node.tag == TAG + "int" else ""
            message = f"the key '{shown(node.value)}' is no text: put it in quotes{comma}"
        elif _has_surrogate(node.value):
            message = "the key holds half a character (a lone surrogate)"
        else:
            return str(node.value)
        self.source.problems.append(Problem(mark, path, message))
        return None

    def _is_new(self, key: str, node: yaml.Node, path: KeyPath, seen: dict[str, Any]) -> bool:
        if key not in seen:
            return True
        first = self.source.keys[*path, key]
        message = f"is given twice, first at line {first.line}, column {first.column}"
        mark = mark_of(node.start_mark, self.source.name)
        self.source.problems.append(Problem(mark, (*path, key), message))
        return False

    def _scalar(self, node: yaml.ScalarNode, path: KeyPath) -> Any:
        kind, text = node.tag.removeprefix(TAG), node.value
        if kind == "str":
            if _has_surrogate(text):
                self.source.add(path, "the text holds half a character (a lone surrogate)")
            return text
        if kind not in CORE_SCALARS:
            self.source.add(path, f"the tag {_tag(node)} is not allowed: a spec is plain data")
        elif not re.fullmatch(CORE_SCALARS[kind][0], text):
            self.source.add(path, f"{shown(text)} is no {kind}, as its tag says")
        elif kind == "int" and abs(number := _integer(text)) > LARGEST_INTEGER:
            self.source.add(path, "the number is too large")
        else:
            return number if kind == "int" else _CONSTRUCT[kind](text)
        return None


def _integer(text: str) -> int:
    base = {"0o": 8, "0x": 16}.get(text[:2], 10)
    # Python refuses to convert thousands of digits; so many are too large in any case.
    return int(text, base) if len(text) < 64 else LARGEST_INTEGER + 1


def _float(text: str) -> float:
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


_CONSTRUCT: dict[str, Any] = {
    "null": lambda text: None,
    "bool": lambda text: text.casefold() == "true",
    "float": lambda text: _float(text.casefold()),
}


def _has_surrogate(text: str) -> bool:
    """Whether UTF-8 cannot hold it; U+DC80 to U+DCFF stand for bytes of names (`hil.core.text`)."""
    return any("\ud800" <= c <= "\udfff" and not "\udc80" <= c <= "\udcff" for c in text)


def _tag(node: yaml.Node) -> str:
    return shown(str(node.tag).replace(TAG, "!!"))


def mark_of(mark: yaml.Mark, name: str) -> Mark:
    """PyYAML's mark, counted from 1."""
    return Mark(name, mark.line + 1, mark.column + 1)
