"""Storage of study results in the file `study/<name>-<digest>/study.json` of a run directory.

The digest in the folder name depends on the name and the parameters of the study. A repeated study
with equal parameters replaces its older result, whereas a study with different parameters gets a
separate folder.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hil.core import DataError, FitError, json_document, write_whole
from hil.studies.result import StudyResult, faults_of

STUDY_FORMAT = 1
STUDIES = "study"
STUDY_FILE = "study.json"
PROBLEM_FILE = "problem.json"
DIGEST_LENGTH = 12


def folder_of(name: str, parameters: Mapping[str, Any]) -> str:
    """Return the folder name `<name>-<digest>` of a study with all its parameters."""
    text = json_document({"study": name, "parameters": dict(sorted(parameters.items()))})
    return f"{name}-{hashlib.sha256(text).hexdigest()[:DIGEST_LENGTH]}"


def write_study(result: StudyResult, folder: Path) -> Path:
    """Write `study.json` atomically, replacing an older file, and return its path.

    Raises:
        FitError: The result cannot be displayed or converted to JSON; an existing file stays
            unchanged.
    """
    if faults := faults_of(result):
        raise FitError(
            f"the result of {result.study} cannot be shown: {'; '.join(faults[:5])}",
            hint="this is a fault of the study: report it to the author of the study",
        )
    path = _write(folder / STUDY_FILE, {"hil_study": STUDY_FORMAT, **result.to_dict()})
    (folder / PROBLEM_FILE).unlink(missing_ok=True)
    return path


def write_problem(name: str, error: str, hint: str, folder: Path) -> Path:
    """Write the reason why a study has no new result to `problem.json`, and return its path."""
    return _write(folder / PROBLEM_FILE, {"study": name, "error": error, "hint": hint})


def read_study(path: Path) -> StudyResult:
    """Read the study result in a `study.json` file.

    Raises:
        DataError: The file is damaged, or was written by a newer version of hil.
    """
    again = "execute the study again: hil study RUN"
    try:
        raw = json.loads(path.read_text("utf-8"))
        if int(raw["hil_study"]) > STUDY_FORMAT:
            raise DataError(f"{path} was written by a newer version of hil", hint=again)
        result = StudyResult.from_dict(raw)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{path} is damaged: {type(error).__name__}: {error}", hint=again
        ) from error
    if faults := faults_of(result):
        raise DataError(f"{path} cannot be shown: {faults[0]}", hint=again)
    return result


def study_files(run: Path) -> Sequence[Path]:
    """Return the `study.json` files of a run, sorted by folder name."""
    return sorted((run / STUDIES).glob(f"*/{STUDY_FILE}"))


def problem_files(run: Path) -> Sequence[Path]:
    """Return the `problem.json` files of the studies of a run, sorted by folder name."""
    return sorted((run / STUDIES).glob(f"*/{PROBLEM_FILE}"))


def _write(path: Path, document: Mapping[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json_document(document))
    return path
