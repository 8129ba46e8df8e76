"""Stages that build on each other: what is done is not done again, also after a crash.

    FOLDER/stages/NAME.json

What came of a stage, and a hash of what it was made from: its own settings and what came of the
stages it needs. While both agree it stays; otherwise it and everything after it is made anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from hil.core import RecordingError, json_document, json_line, sha256_of, write_whole

Document = dict[str, Any]
Do = Callable[[Mapping[str, Document]], Mapping[str, Any]]
FOLDER = "stages"
FORMAT = 1


@dataclass(frozen=True, slots=True)
class Stage:
    """One thing to be done.

    Attributes:
        name: Of its document.
        do: Does it; given the documents of the stages it needs, by name. It may be called again
            after a crash, so that what must not happen twice has to be looked for first.
        needs: Names of stages before it.
        inputs: What else it depends on, as JSON; a path stands for the content of its file.
    """

    name: str
    do: Do
    needs: tuple[str, ...] = ()
    inputs: Mapping[str, Any] = field(default_factory=dict)


def run_stages(stages: Sequence[Stage], folder: Path) -> dict[str, Document]:
    """Do what is not done yet, in the order of needs.

    Args:
        stages: Of distinct names.
        folder: Their documents are kept in `stages` below it.

    Returns:
        The documents of all, by name.

    Raises:
        ValueError: A stage needs one that there is not, or, by a detour, itself.
        RecordingError: A document cannot be written.
        HilError: What a stage raises.
    """
    home = folder / FOLDER
    done: dict[str, Document] = {}
    marks: dict[str, str] = {}
    for stage in _ordered(stages):
        key = _key(stage, marks)
        path = home / f"{stage.name}.json"
        document = _kept(path, key)
        if document is None:
            document = _plain(stage.do({name: done[name] for name in stage.needs}))
            _keep(path, stage.name, key, document)
        done[stage.name] = document
        marks[stage.name] = _digest([key, document])
    return done


def _ordered(stages: Sequence[Stage]) -> list[Stage]:
    named = {stage.name: stage for stage in stages}
    if len(named) != len(stages):
        raise ValueError("two stages have the same name")
    missing = {need for stage in stages for need in stage.needs} - set(named)
    if missing:
        raise ValueError(f"there is no stage {', '.join(sorted(missing))}")
    try:
        order = TopologicalSorter({stage.name: stage.needs for stage in stages}).static_order()
        return [named[name] for name in order]
    except CycleError as error:
        raise ValueError(f"stages need each other: {' → '.join(error.args[1])}") from error


def _key(stage: Stage, marks: Mapping[str, str]) -> str:
    """Of what a stage is made from; of a stage before it counts also what that was made from."""
    needed = {name: marks[name] for name in stage.needs}
    return _digest([stage.name, _contents(stage.inputs), needed])


def _digest(value: Any) -> str:
    text = json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """As it reads back from the disk: the first time is like any other."""
    return json.loads(json_line(value))


def _contents(value: Any) -> Any:
    if isinstance(value, Path):
        return {"sha256": sha256_of(value)}
    if isinstance(value, Mapping):
        return {str(key): _contents(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_contents(item) for item in value]
    return value


def _kept(path: Path, key: str) -> Document | None:
    told = _read(path)
    return told["document"] if told and told.get("inputs_sha256") == key else None


def _read(path: Path) -> Document | None:
    """A whole stage file; None where there is none, or a damaged one."""
    try:
        told = json.loads(path.read_bytes())
        document = told["document"]
        whole = told["hil_stage"] == FORMAT and told["document_sha256"] == _digest(document)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return told if whole and isinstance(document, dict) else None


def _keep(path: Path, name: str, key: str, document: Document) -> None:
    told = {
        "hil_stage": FORMAT, "stage": name, "inputs_sha256": key,
        "document_sha256": _digest(document), "document": document,
    }  # fmt: skip
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json_document(told))
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error


def kept_document(folder: Path, name: str) -> Document | None:
    """What came of a stage, whatever it was made from; None if it was not done."""
    told = _read(folder / FOLDER / f"{name}.json")
    return told and told["document"]
