"""Where a run stands, folded from the events of the engine; old and partial events will do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

PACE_KNOWN_AFTER_S = 0.5
"""A virtual clock needs a moment to show its pace; before that the plan's own time stands [s]."""

BEHIND_SHOWN_S = 0.5
"""A recorder that is less behind than this is keeping up [s]."""

PAUSED = "paused"
ENDING = ("stopping", "done")


@dataclass(slots=True)
class Standing:
    """What is known of a run so far.

    Attributes:
        stage: What the campaign does: planning, running, fitting.
        state, reason: Of the engine, and why it is in that state.
        step, steps: Index of the step that is executed, and how many there are.
        doing, pose, trajectory, load: What kind of step it is, and of what; −1 for none.
        device_s, wall_s: Since the run began [s].
        duration_s: Planned, pauses and prompts left out [s].
        samples, gaps, missing, duplicates, overruns: Of the robot record.
        behind_s: How far the recorder is behind [s].
        pausing: Why it will pause at the next checkpoint, empty while it will not.
        prompt: What the operator is being asked, empty while nothing.
        asked: Number of the newest prompt of this attempt, from 1; 0 where nobody has counted.
        paused_s: Device time spent paused or waiting for an answer [s].
        resumed: 1 where the run was gone on with: times and shares are of what was left then.
    """

    stage: str = ""
    state: str = "idle"
    reason: str = ""
    step: int = -1
    steps: int = 0
    doing: str = ""
    pose: int = -1
    trajectory: int = -1
    load: int = -1
    device_s: float = 0.0
    wall_s: float = 0.0
    duration_s: float = 0.0
    samples: int = 0
    gaps: int = 0
    missing: int = 0
    duplicates: int = 0
    overruns: int = 0
    behind_s: float = 0.0
    pausing: str = ""
    prompt: str = ""
    asked: int = 0
    paused_s: float = 0.0
    resumed: int = 0

    def take(self, event: Mapping[str, Any]) -> None:
        """Learn from an event; keys it lacks keep their value, kinds it does not know are left."""
        kind = event.get("kind")
        if kind == "stage":
            self.stage = str(event.get("stage", ""))
        elif kind == "state":
            self.state = str(event.get("state", self.state))
            self.reason = str(event.get("reason", ""))
            self.pausing = ""
        elif kind == "prompt":
            self._take_prompt(event)
        elif kind in ("step", "progress"):
            before = self.device_s
            for name in _COUNTED & event.keys():
                if _known(event[name]):
                    setattr(self, name, event[name])
            if self.waits:
                self.paused_s += max(0.0, self.device_s - before)

    def _take_prompt(self, event: Mapping[str, Any]) -> None:
        if event.get("answered_by"):
            self.prompt = ""
            return
        number = event.get("asked")
        self.prompt = str(event.get("text", ""))
        self.asked = number if isinstance(number, int) else self.asked + 1

    @property
    def waits(self) -> bool:
        """Whether the program stands still: paused, or somebody is asked something."""
        return self.state == PAUSED or bool(self.prompt)

    @property
    def completed(self) -> bool:
        """Whether the program came to its end: a run that is stopped early has a reason."""
        return self.state in ENDING and self.reason in ("", "completed") and self.steps > 0

    @property
    def moved_s(self) -> float:
        """Device time of the program itself, without pauses and prompts [s]."""
        return max(0.0, self.device_s - self.paused_s)

    @property
    def share(self) -> float:
        """How much of the program is done, 0 … 1; at most 0.99 before it is completed."""
        if self.completed:
            return 1.0
        # Dwells may take longer than planned: before its end no run is done.
        return min(0.99, self.moved_s / self.duration_s) if self.duration_s > 0 else 0.0

    @property
    def pace(self) -> float:
        """Device seconds per second of wall time, at least 1: a start takes its time once."""
        if self.wall_s > PACE_KNOWN_AFTER_S:
            return max(1.0, self.device_s / self.wall_s)
        return 1.0

    @property
    def left_s(self) -> float:
        """Wall time to the end of the program, should nothing come between [s]."""
        return 0.0 if self.completed else max(0.0, self.duration_s - self.moved_s) / self.pace

    @property
    def troubles(self) -> list[str]:
        """What a recording should not have, in words; nothing when all is well.

        Late samples are not among them: none is lost, and a busy machine has many.
        """
        missing = f" ({self.missing} samples missing)" if self.missing else ""
        said = [
            _count(self.gaps, "gap") + missing if self.gaps else "",
            _count(self.duplicates, "duplicate"),
            f"recorder {self.behind_s:.1f} s behind" if self.behind_s > BEHIND_SHOWN_S else "",
        ]
        return [text for text in said if text]

    def snapshot(self) -> dict[str, Any]:
        """Everything that is known, for JSON."""
        known = {field.name: getattr(self, field.name) for field in fields(self)}
        return known | {"percent": round(100 * self.share, 2), "left_s": round(self.left_s, 2)}


_COUNTED = {field.name for field in fields(Standing)} - {
    "stage", "reason", "prompt", "asked", "paused_s",
}  # fmt: skip


def _known(value: Any) -> bool:
    """Times are NaN before the first sample."""
    return not isinstance(value, float) or math.isfinite(value)


def _count(number: int, what: str) -> str:
    if not number:
        return ""
    return f"1 {what}" if number == 1 else f"{number} {what}s"
