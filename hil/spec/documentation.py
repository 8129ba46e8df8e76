"""Documentation of the keys of the YAML files for users and editors, generated from the models.

- `explain_key` and the reference page show unit, default and meaning of each key (`python -m
  hil.spec.documentation docs/reference/spec.md` writes the page);
- the JSON Schema lets editors complete keys and mark errors while typing (`python -m
  hil.spec.documentation experiments/schema` writes the schemas of the shipped specs);
- comments in templates describe the keys: a line that ends in `#?` gets the description of its key,
  followed by the text after `#?`. The comments in templates therefore contain the same texts as the
  reference page.
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic.json_schema import GenerateJsonSchema

from hil.core import KeyPath, SpecError, closest, dotted, split_unit, symbol_of
from hil.spec.experiment import ExperimentSpec
from hil.spec.fleet import FleetSpec
from hil.spec.model_tree import Model, choices_of, is_model, keys_of, kinds_of, plain, tree
from hil.spec.schedule import ScheduleSpec
from hil.spec.series import SeriesSpec
from hil.spec.station import Station


@dataclass(frozen=True, slots=True)
class KeyInfo:
    """Documentation of one key of a YAML file.

    Attributes:
        path: Dotted path of the key without list indices: `loads.mass_kg`.
        kind: Value of `kind` in the mapping that contains the key; empty if the mapping has no
            kinds.
        unit: Symbol of the key's unit; empty for a key without a unit.
        allowed: Allowed values of the key, as text.
        default: Default value of the key as YAML; `required` if there is no default.
        meaning: Meaning of the key, as a sentence.
        file: Kind of YAML file: `experiment`, `station`, `series`, `schedule` or `fleet`.
    """

    path: str
    kind: str
    unit: str
    allowed: str
    default: str
    meaning: str
    file: str = ""


MODELS: dict[str, Model] = {
    "experiment": ExperimentSpec,
    "station": Station,
    "series": SeriesSpec,
    "schedule": ScheduleSpec,
    "fleet": FleetSpec,
}
"""Pydantic model of each kind of YAML file."""


def keys_below(model: Model) -> Iterator[KeyInfo]:
    """Yield the documentation of all keys of a kind of file, from top to bottom."""
    for path, owner in tree(model):
        for key, field in keys_of(owner).items():
            yield _info((*path, key), owner, field)


def _info(path: KeyPath, owner: Model, field: FieldInfo) -> KeyInfo:
    kind_field = keys_of(owner).get("kind")
    kinds = choices_of(kind_field.annotation) if kind_field else ()
    return KeyInfo(
        path=dotted(path),
        kind=kinds[0] if kinds else "",
        unit=symbol_of(str(path[-1])),
        allowed=_allowed(field.annotation, field.metadata),
        default=_default(field),
        meaning=field.description or "",
    )


def _allowed(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """Return the allowed values of an annotation as text."""
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return _allowed(inner, [*metadata, *more])
    if (inner := plain(annotation)) is not annotation:
        return _allowed(get_args(annotation)[0], metadata)
    if choices := choices_of(inner):
        return " or ".join(f"`{choice}`" for choice in choices)
    if inner in (float, int):
        return ("number" if inner is float else "whole number") + _limits(metadata)
    return _compound(inner)


def _limits(metadata: Sequence[Any]) -> str:
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = {}
    for item in _flat(metadata):
        for name, sign in signs.items():
            if getattr(item, name, None) is not None:
                found[name] = f"{sign} {getattr(item, name):.10g}"
    return " " + ", ".join(found.values()) if found else ""


def _flat(metadata: Sequence[Any]) -> Iterator[Any]:
    for item in metadata:
        yield from item.metadata if isinstance(item, FieldInfo) else (item,)


def _compound(inner: Any) -> str:
    if kinds := kinds_of(inner):
        return "mapping with `kind` " + ", ".join(f"`{kind}`" for kind in kinds)
    if get_origin(inner) in (Union, types.UnionType):
        return " or ".join(_allowed(arg) for arg in get_args(inner))
    if inner is bool:
        return "`true` or `false`"
    if get_origin(inner) is tuple:
        first, *rest = get_args(inner)
        if rest == [Ellipsis]:
            return f"list, each entry: {_allowed(first)}"
        return f"list of {1 + len(rest)}: {_allowed(first)}"
    if is_model(inner) or get_origin(inner) is dict:
        return "mapping"
    return "text"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if isinstance(value, BaseModel):
        return "see below"
    if value is None:
        return "none"
    if isinstance(value, tuple):
        value = [v.model_dump(exclude_unset=True) if isinstance(v, BaseModel) else v for v in value]
    return f"`{json.dumps(value, ensure_ascii=False)}`" if value != "" else "empty"


def explain_key(path: str) -> list[KeyInfo]:
    """Return the meaning of a dotted path in a file; several entries if kinds share the key.

    Raises:
        SpecError: The kind of file has no such key.
    """
    wanted = tuple(step for step in path.split(".") if not step.isdigit())
    known = [
        replace(info, file=file) for file, model in MODELS.items() for info in keys_below(model)
    ]
    found = [info for info in known if _ends_in(info, wanted)]
    if not found:
        match = _meant(wanted, sorted({info.path for info in known}))
        hint = f"did you mean {match!r}?" if match else "all keys: docs/reference/spec.md"
        raise SpecError(f"unknown key {'.'.join(wanted)!r}", hint=hint)
    return [info for info in found if info.path.count(".") == len(wanted) - 1] or found


def _ends_in(info: KeyInfo, wanted: tuple[str, ...]) -> bool:
    """Return whether a path ends in these steps; an entry of a dict matches any name."""
    steps = info.path.split(".")[-len(wanted) :]
    return len(steps) == len(wanted) and all(
        step in (given, "<name>") for step, given in zip(steps, wanted, strict=True)
    )


def _meant(wanted: Sequence[str], paths: Sequence[str]) -> str | None:
    """Return the path, or the end of a path, that the user most likely meant."""
    typed = ".".join(wanted)
    ends = {".".join(path.split(".")[-len(wanted) :]) for path in paths}
    return closest(typed, paths) or closest(typed, sorted(ends))


def section_of(info: KeyInfo) -> str:
    """Return the title of the section of the reference page that contains a key."""
    above = info.path.rpartition(".")[0]
    kind = f" with `kind: {info.kind}`" if info.kind else ""
    return f"`{above}`{kind}" if above else "Top of the file"


_HEAD = """# Keys of the YAML files

This page is generated from the models in `hil/spec` by `python -m hil.spec.documentation`; a test
keeps it up to date. An editor with YAML support shows the same texts while you type, because the
first line of every shipped spec names its schema (`# yaml-language-server: $schema=…`).

- The key of a quantity contains the unit: `dwell_s: 0.095`, never `dwell: 95 ms`.
- A key that is not listed here is an error; the message suggests the intended key.
- Scalars follow YAML 1.2: `1e-3` is a number; `on`, `yes` and `12:30` are text.
- Anchors and aliases (`&a`, `*a`) are allowed. With all aliases expanded, a file may contain
  10 000 values plus 2 per character, in at most 40 levels. A larger file is rejected during
  parsing.
- Relative paths start at the folder of the file that contains them.
- The value of `kind` determines the other keys of its mapping."""


def reference() -> str:
    """Return the reference page in Markdown."""
    parts = [_HEAD]
    for file, model in MODELS.items():
        parts += [f"## {file.capitalize()}", _sections(model)]
    return "\n\n".join(parts) + "\n"


def _sections(model: Model) -> str:
    return "\n\n".join(_section(path, owner) for path, owner in tree(model))


def _section(path: KeyPath, owner: Model) -> str:
    infos = [_info((*path, key), owner, field) for key, field in keys_of(owner).items()]
    title = f"### {section_of(infos[0])}"
    rows = [
        f"| `{i.path.rpartition('.')[2]}` | {i.unit or '–'} | {i.allowed} | {i.default} | "
        f"{i.meaning} |"
        for i in infos
    ]
    table = ["| key | unit | value | default | meaning |", "|---|---|---|---|---|", *rows]
    return "\n".join([title, "", (owner.__doc__ or "").partition("\n")[0], "", *table])


DIALECT = "https://json-schema.org/draft/2020-12/schema"


def schema_of(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a kind of file, one of `MODELS`."""
    schema = MODELS[kind].model_json_schema(by_alias=True, schema_generator=_WithUnits)
    head = {"$schema": DIALECT, "$id": f"urn:hil:schema:{kind}:1", "title": f"hil {kind}"}
    return head | {key: value for key, value in schema.items() if key not in head}


class _WithUnits(GenerateJsonSchema):
    """Schema generator of pydantic with units in the titles."""

    def get_title_from_name(self, name: str) -> str:
        """Return the title of a key, for example `mass [kg]` for `mass_kg`."""
        unit = symbol_of(name)
        words = split_unit(name)[0].replace("_", " ")
        return f"{words} [{unit}]" if unit else words


@cache
def schema_files() -> dict[str, str]:
    """Return the text of every schema file by name."""
    return {
        f"{kind}.schema.json": json.dumps(schema_of(kind), indent=2, ensure_ascii=False) + "\n"
        for kind in MODELS
    }


def write_schemas(folder: Path) -> None:
    """Write the schema files into a folder; create the folder if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in schema_files().items():
        (folder / name).write_text(text, "utf-8")


COLUMN = 36
"""Column at which the comments of a template begin."""

WIDTH = 100

NARROWEST = 40
"""Minimum width of a comment behind its line; a narrower comment is placed above the line."""


def commented(text: str, model: Model) -> str:
    """Return a template with comments that describe its keys.

    Args:
        text: YAML text of the template, whose lines may end in ` #? more`.
        model: Pydantic model of the file.

    Raises:
        SpecError: A line with the mark `#?` has a key that does not exist in the model.
    """
    known = list(keys_below(model))
    return "\n".join(line for one in _lines(text) for line in _written(one, known)) + "\n"


_LINE = re.compile(
    r"(?P<indent> *)(?P<off># )?(?P<dash>- )?(?P<key>[\w.<>-]+|\"[\w.-]+\"):(?P<rest>.*)"
)


def _lines(text: str) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Yield each line of a template with the path of its key and the `kind` of its mapping."""
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


_MARK = "  #?"


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
    """Return the documentation of the key at a path; entries of a dict match any name."""
    for info in known:
        if info.kind in ("", kind) and _is_at(info, path):
            return info
    raise SpecError(f"a template contains the unknown key {'.'.join(path)}")


def _is_at(info: KeyInfo, path: tuple[str, ...]) -> bool:
    steps = info.path.split(".")
    return len(steps) == len(path) and all(
        step in (given, "<name>") for step, given in zip(steps, path, strict=True)
    )


def _wrapped(comment: str, width: int) -> list[str]:
    return textwrap.wrap(comment, width, break_on_hyphens=False)


def comment_of(info: KeyInfo, more: str = "") -> str:
    """Return a sentence about a key: unit and range, meaning, and additional text."""
    allowed = info.allowed.replace("`", "")
    limits = re.sub(r"^(whole )?number ?", "", allowed)
    if not re.match(r"(whole )?number", allowed):
        limits = allowed if " or " in allowed and not info.allowed.startswith("list") else ""
    head = ", ".join(part for part in (info.unit, limits) if part)
    said = f"{head}: {info.meaning}" if head else info.meaning
    return f"{said} {more}".strip()


def describe_keys(key: str) -> list[dict[str, Any]]:
    """Return the documentation of a key in the format of `hil explain --json`.

    The list has several entries if the key has different meanings in different kinds. If several
    mappings share a key with the same texts, the list contains one entry for the key, without a
    kind.

    Args:
        key: Dotted path in a file, or the end of a dotted path.

    Raises:
        SpecError: No kind of YAML file has this key.
    """
    wanted = key.strip().strip(".")
    if "" in wanted.split(".") or wanted.replace(".", "").isdigit():
        raise SpecError(f"{key!r} is not a key", hint="for example: hil explain excitation.dwell_s")
    infos: dict[tuple[str, ...], KeyInfo] = {}
    for info in explain_key(wanted):
        words = (info.file, info.path, info.allowed, info.default, info.meaning)
        infos[words] = replace(info, kind="") if words in infos else info
    return [
        {
            "file": info.file,
            "path": info.path,
            "kind": info.kind,
            "unit": info.unit,
            "allowed": info.allowed.replace("`", ""),
            "default": info.default.strip("`"),
            "meaning": info.meaning,
            "keys_below": list(dict.fromkeys(one.path.rpartition(".")[2] for one in _below(info))),
            "example": example_of(info),
            "documented": f"docs/reference/spec.md, {info.file.capitalize()}, {section_of(info)}",
        }
        for info in infos.values()
    ]


def _below(info: KeyInfo) -> list[KeyInfo]:
    """Return the keys of the mapping at a key, for all kinds of this mapping."""
    known = keys_below(MODELS[info.file])
    above = (info.path, f"{info.path}.<name>")  # entries of a dict have arbitrary names
    return [replace(one, file=info.file) for one in known if one.path.rpartition(".")[0] in above]


def example_of(info: KeyInfo) -> str:
    """Return an example line for a key: as in the templates of `hil new`, else with the default.

    For a mapping, the example shows the first key of the mapping that has an example; the text is
    empty if no key has an example.
    """
    for code, path, kind in _examples():
        if info.kind in ("", kind) and _is_at(info, path):
            return code
    key = info.path.rpartition(".")[2]
    if info.default.startswith("`"):
        return f"{key}: {info.default.strip('`')}"
    inside = next((line for one in _below(info) if (line := example_of(one))), "")
    if not inside:
        return ""
    return f"{key}: [{{{inside}}}]" if info.allowed.startswith("list") else f"{key}: {{{inside}}}"


@cache
def _examples() -> tuple[tuple[str, tuple[str, ...], str], ...]:
    """Return the template lines without comment and indentation, each with path and kind."""
    found = []
    for file in sorted(files("hil.spec").joinpath("templates").iterdir(), key=lambda f: f.name):
        for line, path, kind in _lines(file.read_text("utf-8")):
            code = re.sub(r" +#[ ?].*", "", line).strip().lstrip("#- ")
            if path and "@" not in code and not code.endswith(":"):
                found.append((code, path, kind))
    return tuple(found)


if __name__ == "__main__":
    to = Path(sys.argv[1])
    if to.suffix == ".md":
        to.write_text(reference(), "utf-8")
    else:
        write_schemas(to)
