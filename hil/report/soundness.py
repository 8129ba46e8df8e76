"""Whether the files that a run goes on from are what they should be; what is not is a warning."""

from __future__ import annotations

from pathlib import Path

from hil.core import DataError
from hil.data import FOUND_FILE
from hil.planning import Plan, read_plan
from hil.recording import RunDirectory, has_its_beginning, hint_of_lost, torn_although_finished
from hil.report.documents import Document, document


def plan_of(path: Path, problems: list[str]) -> tuple[Document, Plan | None]:
    """The plan as it stands there, and as what it is; None for one that nobody can execute.

    What was found in a passive recording is shown like a plan, and is none.
    """
    if not path.exists():
        return document(path.with_name(FOUND_FILE), problems), None
    told = document(path, problems)
    try:
        return told, read_plan(path)
    except DataError as error:
        if error.message not in problems:
            problems.append(error.message)
        return told, None


def is_known(path: Path, start: Document, problems: list[str]) -> bool:
    """Whether the start document is one; a damaged one is a problem already."""
    if "hil_run" in start:
        return True
    if path.exists() and not any(str(path) in problem for problem in problems):
        problems.append(f"{path} does not say which format it has (hil_run)")
    return False


def torn(run: RunDirectory) -> list[str]:
    """Finished recordings that have lost their end or their beginning, in words."""
    return [
        f"{path.name} is torn although it was finished: hil recover {run.path} makes a whole file "
        "of what is left"
        if has_its_beginning(path)
        else f"{path.name} is no MCAP file any more, its beginning is lost: {hint_of_lost(path)}"
        for path in torn_although_finished(run.recordings)
    ]
