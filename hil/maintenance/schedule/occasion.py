"""An occasion: something that was due at some time, done once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol

Job = Literal["probe", "campaign"]


@dataclass(frozen=True, slots=True, order=True)
class Occasion:
    """Something that is due.

    Attributes:
        due: When, in UTC.
        job: What: `probe` (and what follows from it), or the whole `campaign`.
    """

    due: datetime
    job: Job

    @property
    def id(self) -> str:
        """Unique within a schedule, and fit for a folder's name: `20261128T030000Z-probe`."""
        return f"{self.due.astimezone(UTC):%Y%m%dT%H%M%SZ}-{self.job}"


class Work(Protocol):
    """Does what is due, or goes on with it where a crash has left it."""

    def __call__(self, occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        """Do it; what is done already in `folder` is not done again.

        Args:
            occasion: What is due.
            folder: Of this occasion alone; the same one whenever it is gone on with.

        Returns:
            What came of it, for the ledger, notifications and people: at least `text` (one line)
            and `outcome` (`quiet`, `drift`, `promoted`, `kept`).

        Raises:
            HilError: It could not be done, or not to its end.
        """
