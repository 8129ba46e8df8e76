"""A finding: the result of one check."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check.

    Attributes:
        what: What was checked.
        finding: The result, and the remedy when it is not `ok`.
        level: `ok`, `note` or `bad`.
    """

    what: str
    finding: str
    level: str = "ok"

    @property
    def bad(self) -> bool:
        """Whether `hil` cannot do its main job."""
        return self.level == "bad"

    @property
    def mark(self) -> str:
        """The level as a word, so that nothing depends on colour."""
        return {"ok": "ok", "note": "note", "bad": "BAD"}[self.level]

    def to_dict(self) -> dict[str, str]:
        """Return the JSON form."""
        return {"what": self.what, "finding": self.finding, "level": self.level}
