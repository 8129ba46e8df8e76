"""Every key of the YAML files with its unit, default and meaning, taken from the models.

`python -m hil.spec.describe docs/reference/spec.md` writes the reference page.
"""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from hil.core import KeyPath, SpecError, closest, dotted, symbol_of
from hil.spec.experiment import ExperimentSpec
from hil.spec.fleet import FleetSpec
from hil.spec.model_tree import Model, choices_of, is_model, keys_of, kinds_of, plain, tree
from hil.spec.schedule import ScheduleSpec
from hil.spec.series import SeriesSpec
from hil.spec.station import Station


@dataclass(frozen=True, slots=True)
class KeyInfo:
    """What there is to know about one key.

    Attributes:
        path: Dotted path without list indices: `loads.mass_kg`.
        kind: The `kind` of the mapping it belongs to, empty where there are no kinds.
        unit: Symbol of its unit, empty without one.
        allowed: The values it takes, in words.
        default: Its default as YAML, `required` without one.
        meaning: What it says.
        file: The kind of file it is in: `experiment`, `station`, `series`, `schedule` or `fleet`.
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
"""The YAML files by what they are called."""


def keys_below(model: Model) -> Iterator[KeyInfo]:
    """All keys of a file, from the top downwards."""
    for path, owner in tree(model):
        for key, field in keys_of(owner).items():
            yield _info((*path, key), owner, field)


def explain_key(path: str) -> list[KeyInfo]:
    """What a dotted path in a file means; several entries if kinds share it.

    Raises:
        SpecError: There is no such key.
    """
    wanted = tuple(step for step in path.split(".") if not step.isdigit())
    known = [
        replace(info, file=file) for file, model in MODELS.items() for info in keys_below(model)
    ]
    found = [info for info in known if _ends_in(info, wanted)]
    if not found:
        match = _meant(wanted, sorted({info.path for info in known}))
        hint = f"did you mean {match!r}?" if match else "all keys: docs/reference/spec.md"
        raise SpecError(f"no spec has the key {'.'.join(wanted)!r}", hint=hint)
    return [info for info in found if info.path.count(".") == len(wanted) - 1] or found


def _meant(wanted: Sequence[str], paths: Sequence[str]) -> str | None:
    """The path, or the end of one, that a person most likely meant."""
    typed = ".".join(wanted)
    ends = {".".join(path.split(".")[-len(wanted) :]) for path in paths}
    return closest(typed, paths) or closest(typed, sorted(ends))


def section_of(info: KeyInfo) -> str:
    """Title of the reference page's section that a key is in."""
    above = info.path.rpartition(".")[0]
    kind = f" with `kind: {info.kind}`" if info.kind else ""
    return f"`{above}`{kind}" if above else "Top of the file"


def _ends_in(info: KeyInfo, wanted: tuple[str, ...]) -> bool:
    """Whether a path ends in these steps; an entry of a dict goes by any name."""
    steps = info.path.split(".")[-len(wanted) :]
    return len(steps) == len(wanted) and all(
        step in (given, "<name>") for step, given in zip(steps, wanted, strict=True)
    )


def reference() -> str:
    """The reference page in Markdown."""
    parts = [_HEAD]
    for file, model in MODELS.items():
        parts += [f"## {file.capitalize()}", _sections(model)]
    return "\n\n".join(parts) + "\n"


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


def _allowed(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """The values of an annotation in words."""
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


_HEAD = """# Keys of the YAML files

This page is made from the models in `hil/spec` by `python -m hil.spec.describe`; a test keeps it
up to date. In an editor with YAML support the first line of the shipped specs
(`# yaml-language-server: $schema=…`) brings the same texts while you type.

- Quantities carry their unit in the key: `dwell_s: 0.095`, never `dwell: 95 ms`.
- A key that is not listed here is an error, with a guess at what was meant.
- Scalars follow YAML 1.2: `1e-3` is a number; `on`, `yes` and `12:30` are text.
- Anchors and aliases (`&a`, `*a`) are allowed; with all aliases followed, a file may
  hold 10 000 values and 2 more for each of its characters, in at most 40 levels. A larger file is
  rejected during parsing.
- Relative paths start at the folder of the file they stand in.
- A `kind` decides which other keys there are."""


if __name__ == "__main__":
    FilePath(sys.argv[1] if len(sys.argv) > 1 else "docs/reference/spec.md").write_text(
        reference(), "utf-8"
    )
