"""Finding: result of one check of a computer or robot."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check of a computer or robot.

    Attributes:
        what: Subject of the check, such as a package or a folder.
        finding: Result of the check, and the remedy if the level is not `ok`.
        level: Severity of the finding: `ok`, `note` or `bad`.
    """

    what: str
    finding: str
    level: str = "ok"

    @property
    def bad(self) -> bool:
        """Whether the problem prevents the main function of `hil`."""
        return self.level == "bad"

    @property
    def mark(self) -> str:
        """Level of the finding as a word, so that the output does not depend on color."""
        return {"ok": "ok", "note": "note", "bad": "BAD"}[self.level]

    def to_dict(self) -> dict[str, str]:
        """Return the JSON form of the finding."""
        return {"what": self.what, "finding": self.finding, "level": self.level}
