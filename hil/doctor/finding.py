"""What a look at one thing has found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        what: The thing.
        finding: What was found, and how to mend it when bad.
        level: `ok`, `note` or `bad`.
    """

    what: str
    finding: str
    level: str = "ok"

    @property
    def bad(self) -> bool:
        """True when `hil` cannot do its main job."""
        return self.level == "bad"

    @property
    def mark(self) -> str:
        """A word, so that nothing depends on colour."""
        return {"ok": "ok", "note": "note", "bad": "BAD"}[self.level]

    def to_dict(self) -> dict[str, str]:
        """JSON form."""
        return {"what": self.what, "finding": self.finding, "level": self.level}
