"""What the studies of a run found, read leniently: a damaged file becomes a warning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hil.core import DataError
from hil.report.documents import Document, document
from hil.studies import StudyResult, problem_files, read_study, study_files


@dataclass(frozen=True, slots=True)
class StudyFacts:
    """The studies of a run.

    Attributes:
        made: What they found, in order of folder name.
        failed: Why studies have no result, or only an older one: `study`, `error`, `hint`.
    """

    made: tuple[StudyResult, ...] = ()
    failed: Sequence[Document] = ()

    @property
    def known(self) -> frozenset[str]:
        """The studies that were made or tried."""
        tried = (str(problem.get("study")) for problem in self.failed)
        return frozenset({*(result.study for result in self.made), *tried})

    @property
    def warnings(self) -> list[str]:
        """What is missing and why, then what the studies themselves left out."""
        missing = [
            f"The study {problem.get('study')} could not be made: "
            + " → ".join(filter(None, (str(problem.get(key) or "") for key in ("error", "hint"))))
            for problem in self.failed
        ]
        told = [f"{result.title}: {text}" for result in self.made for text in result.warnings]
        return missing + told


def read_studies(run: Path, problems: list[str]) -> StudyFacts:
    """The studies of a run; files that cannot be used are named in `problems`."""
    made = []
    for path in study_files(run):
        try:
            made.append(read_study(path))
        except DataError as error:
            problems.append(error.message)
    failed = [document(path, problems) for path in problem_files(run)]
    return StudyFacts(tuple(made), [problem for problem in failed if problem])
