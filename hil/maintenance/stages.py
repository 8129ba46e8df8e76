"""Dependent stages of work: a finished stage is not repeated, even after a crash.

`FOLDER/stages/NAME.json` contains the result of a stage and a hash of the stage's inputs. The
inputs are the settings of the stage and the results of the stages it depends on. As long as the
hash of its inputs stays the same, the result of a stage is reused. If the hash differs, the stage
and all dependent stages are repeated. A damaged file of a stage counts as missing.
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
    """Stage of work whose result is stored.

    Attributes:
        name: Name of the stage and of the file with its result.
        do: Function that does the work of the stage; it receives the results of the stages in
            `needs`, by name, and returns its own result. The function `do` may be called again
            after a crash, so it must check for side effects that already exist.
        needs: Names of the stages whose results this stage uses.
        inputs: Further inputs as JSON; a path represents the content of the file.
    """

    name: str
    do: Do
    needs: tuple[str, ...] = ()
    inputs: Mapping[str, Any] = field(default_factory=dict)


def run_stages(stages: Sequence[Stage], folder: Path) -> dict[str, Document]:
    """Do the unfinished stages in the order of their dependencies.

    Args:
        stages: Stages with distinct names.
        folder: Folder whose subfolder `stages` contains the results of the stages.

    Returns:
        Results of all stages, by name.

    Raises:
        ValueError: A stage depends on a stage that does not exist, or the dependencies are
            circular.
        RecordingError: The result of a stage cannot be written.
        HilError: A stage failed.
    """
    results: dict[str, Document] = {}
    marks: dict[str, str] = {}
    for stage in _ordered(stages):
        # The mark of a stage in `needs` depends on the inputs of that stage, too. An equal result
        # from different inputs therefore counts as a different result.
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
    """Return the stored result of a stage, whatever its inputs; None if there is no result."""
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
        raise ValueError(f"stages depend on each other: {' → '.join(error.args[1])}") from error


def _digest(value: Any) -> str:
    text = json.dumps(_plain(value), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return a value in the form that it has after it was written to a file and read again."""
    return json.loads(json_line(value))


def _contents(value: Any) -> Any:
    """Return inputs in which the paths of files are replaced by the digests of the files."""
    if isinstance(value, Path):
        return {"sha256": sha256_of(value)}
    if isinstance(value, Mapping):
        return {str(key): _contents(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_contents(item) for item in value]
    return value


def _read(path: Path) -> Document | None:
    """Return the content of a stage file, or None if the file is missing or damaged."""
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
            hint="check that the folder is writable and that the disk has space",
        ) from error
