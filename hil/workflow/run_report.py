"""The result of a run, for scripts, notebooks and `hil run --json`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.core import HilError, Tone, card
from hil.evaluation import VerdictWord


@dataclass(frozen=True, slots=True, eq=False)
class RunReport:
    """Result of an experiment.

    Attributes:
        run: The run directory.
        uid: Its identity.
        outcome: `completed`, `stopped`, `tripped` or `failed`.
        verdict: Of the models on held-out data; `not judged` when the run ended early or the
            spec has no criteria.
        samples, gaps, duplicates: Of the robot record, by device clock.
        models: Folders of what was fitted, by name.
        report: The HTML page, None if it could not be made.
        error: What ended the run or the fit early.
    """

    run: Path
    uid: str
    outcome: str
    verdict: VerdictWord
    samples: int
    gaps: int
    duplicates: int
    models: tuple[Path, ...]
    report: Path | None
    error: HilError | None = None

    def __repr__(self) -> str:
        return f"<RunReport {self.run}: {self.outcome}, {self.verdict}>"

    def _repr_html_(self) -> str:
        """Return the card for a notebook."""
        tones: dict[str, Tone] = {"passed": "pass", "rejected": "fail"}
        facts = {
            "outcome": self.outcome,
            "samples": f"{self.samples:,}",
            "gaps": self.gaps,
            "duplicates": self.duplicates,
            "models": ", ".join(folder.name for folder in self.models),
            "report": self.report or "",
        }
        notes = [self.error.message] if self.error else []
        badge = (self.verdict, tones.get(self.verdict, "warn"))
        return card("Run", self.run, facts, badge=badge, notes=notes)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil run --json`."""
        out: dict[str, Any] = {
            "run": str(self.run),
            "uid": self.uid,
            "outcome": self.outcome,
            "verdict": self.verdict,
            "samples": self.samples,
            "gaps": self.gaps,
            "duplicates": self.duplicates,
            "models": [str(folder) for folder in self.models],
            "report": str(self.report) if self.report else None,
        }
        if self.error is not None:
            out["error"] = {"kind": type(self.error).__name__, "message": self.error.message}
        return out
