"""Stages that build on each other: a stage that is done is not done again, also after a crash.

`FOLDER/stages/NAME.json` has the result of a stage, and a hash of its inputs: its own settings and
the results of the stages it needs. As long as the hash is the same the result stays; otherwise the
stage and everything after it is done again. A damaged file counts as not done.
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
    """One stage.

    Attributes:
        name: Of the stage and its file.
        do: Does it, and returns its result; called with the results of the stages it needs, by
            name. It may be called again after a crash, so that it has to look first for what must
            not happen twice.
        needs: Names of the stages whose results it uses.
        inputs: What else it depends on, as JSON; a path stands for the content of its file.
    """

    name: str
    do: Do
    needs: tuple[str, ...] = ()
    inputs: Mapping[str, Any] = field(default_factory=dict)


def run_stages(stages: Sequence[Stage], folder: Path) -> dict[str, Document]:
    """Do the stages that are not done yet, in the order of their needs.

    Args:
        stages: Of distinct names.
        folder: Their results are stored in `stages` below it.

    Returns:
        The results of all stages, by name.

    Raises:
        ValueError: A stage needs one that does not exist, or (by way of others) itself.
        RecordingError: A result cannot be written.
        HilError: What a stage raises.
    """
    results: dict[str, Document] = {}
    marks: dict[str, str] = {}
    for stage in _ordered(stages):
        # The mark of a needed stage covers its inputs, too: a result that came out equal from
        # other inputs is another one.
        needed = {name: marks[name] for name in stage.needs}
        key = _digest([stage.name, _contents(stage.inputs), needed])
        path = _file_of(folder, stage.name)
        stored = _read(path)
        if stored is not None and stored.get("inputs_sha256") == key:
            result: Document = stored["document"]
        else:
            result = _plain(stage.do({name: results[name] for name in stage.needs}))
            _write(path, stage.name, key, result)
        results[stage.name] = result
        marks[stage.name] = _digest([key, result])
    return results


def stored_result(folder: Path, name: str) -> Document | None:
    """Return the result of a stage, whatever its inputs were; None if it was not done."""
    stored = _read(_file_of(folder, name))
    return stored and stored["document"]


def _file_of(folder: Path, name: str) -> Path:
    return folder / FOLDER / f"{name}.json"


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


def _digest(value: Any) -> str:
    text = json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return a value as it reads back from the disk: the first time is like any other."""
    return json.loads(json_line(value))


def _contents(value: Any) -> Any:
    """Return inputs with the digests of files in place of their paths."""
    if isinstance(value, Path):
        return {"sha256": sha256_of(value)}
    if isinstance(value, Mapping):
        return {str(key): _contents(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_contents(item) for item in value]
    return value


def _read(path: Path) -> Document | None:
    """Return the content of a stage file; None if it is missing or damaged."""
    try:
        stored: Document = json.loads(path.read_bytes())
        result = stored["document"]
        whole = stored["hil_stage"] == FORMAT and stored["document_sha256"] == _digest(result)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return stored if whole and isinstance(result, dict) else None


def _write(path: Path, name: str, key: str, result: Document) -> None:
    content = {
        "hil_stage": FORMAT, "stage": name, "inputs_sha256": key,
        "document_sha256": _digest(result), "document": result,
    }  # fmt: skip
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json_document(content))
    except OSError as error:
        raise RecordingError(
            f"cannot write {path}: {error.strerror or error}",
            hint="see whether the folder may be written to and the disk has room",
        ) from error
