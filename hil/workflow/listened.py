"""What is asked of a passive recording, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.arms import Payload
from hil.core import HilError


@dataclass(frozen=True, slots=True)
class Wanted:
    """What is to be recorded, and until when; whatever comes first. Ctrl-C always ends it.

    Attributes:
        robot: Name in the station.
        name: What people shall call the recording.
        for_s: Duration by the robot's clock [s]; None for no end.
        until_program_stops: End when a program, which may still have to begin, has stopped.
        payload: What is mounted; None when nobody has said.
        operator: Who is at the robot; empty for the user of this process.
    """

    robot: str
    name: str = "recording"
    for_s: float | None = None
    until_program_stops: bool = False
    payload: Payload | None = None
    operator: str = ""


@dataclass(frozen=True, slots=True)
class Listened:
    """What was recorded.

    Attributes:
        run: The run directory.
        reason: What ended it, in words.
        counts: Samples, gaps, missing, duplicates and overruns of the robot record.
        device_s: From the first sample to the last [s].
        steps: How many dwells, moves and trajectories were found.
        notes: For people.
        error: What ended it early.
    """

    run: Path
    reason: str
    counts: dict[str, int]
    device_s: float
    steps: dict[str, int]
    notes: tuple[str, ...] = ()
    error: HilError | None = None

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil record --json`."""
        out = {
            "run": str(self.run),
            "reason": self.reason,
            **self.counts,
            "device_s": self.device_s,
            "found": self.steps,
            "notes": list(self.notes),
        }
        if self.error is not None:
            out["error"] = {"kind": type(self.error).__name__, "message": self.error.message}
        return out
