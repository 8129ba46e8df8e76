"""Where a run stands, and the words for it and for its events.

`Standing` folds the events that the engine publishes into one picture. Terminal, live file,
dashboard and network view each hold one and describe it with the same words, so that a run reads
the same wherever it is watched. Events may be old or partial: keys that are missing change nothing.

Two kinds of events are put into words. `message_of` is for those that observers receive, such as
`{"kind": "step", …}`; `words_of` is for the lines of `events.jsonl`, which hold more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from hil.core import plain

PACE_KNOWN_AFTER_S = 0.5
"""A virtual clock needs a moment to show its pace; before that the plan's own time stands [s]."""

BEHIND_SHOWN_S = 0.5
"""A recorder that is less behind than this is keeping up [s]."""

PAUSED = "paused"
ENDING = ("stopping", "done")

Event = Mapping[str, Any]


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

    def take(self, event: Event) -> None:
        """Update from an event; keys it lacks keep their value, unknown kinds change nothing."""
        kind = event.get("kind")
        if kind == "stage":
            self.stage = str(event.get("stage", ""))
        elif kind == "state":
            self.state = str(event.get("state", self.state))
            self.reason = str(event.get("reason", ""))
            self.pausing = ""
        elif kind == "prompt":
            if event.get("answered_by"):
                self.prompt = ""
            else:
                number = event.get("asked")
                self.prompt = str(event.get("text", ""))
                self.asked = number if isinstance(number, int) else self.asked + 1
        elif kind in ("step", "progress"):
            before = self.device_s
            for name in _COUNTED & event.keys():
                value = event[name]
                if not isinstance(value, float) or math.isfinite(value):  # NaN: no sample yet
                    setattr(self, name, value)
            if self.waits:
                self.paused_s += max(0.0, self.device_s - before)

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


def _count(number: int, what: str) -> str:
    if not number:
        return ""
    return f"1 {what}" if number == 1 else f"{number} {what}s"


def state_words(standing: Standing) -> str:
    """Return the state and its reason: `paused: interlock temperature: …`."""
    return f"{standing.state}: {standing.reason}" if standing.reason else standing.state


def share_words(standing: Standing) -> str:
    """Return ` 12 %`; of a run that was resumed ` 12 % of what was left`."""
    of = " of what was left" if standing.resumed else ""
    return f"{100 * standing.share:3.0f} %{of}"


def step_words(standing: Standing) -> str:
    """Return `step 12/650 dwell, pose 5`; nothing before the first one."""
    if not standing.steps:
        return ""
    if standing.step < 0:  # what a resumed run does before it goes on
        return "on the way back"
    load = standing.load if standing.doing in ("payload", "weigh") else -1
    subjects = (("pose", standing.pose), ("trajectory", standing.trajectory), ("load", load))
    of = [f"{what} {i}" for what, i in subjects if i >= 0]
    doing = ", ".join([standing.doing, *of]) if standing.doing else ""
    return f"step {standing.step + 1}/{standing.steps} {doing}".rstrip()


def answer_words(event: Event) -> str:
    """Return `answered by anna`, or `anna answered no`: that ends the run."""
    who = event.get("answered_by") or "nobody"
    return f"{who} answered no" if event.get("answer") == "no" else f"answered by {who}"


# Events that observers receive.

DEBUG, INFO, WARNING, ERROR = 10, 20, 30, 40
"""Levels of `rcl_interfaces/msg/Log`."""


def message_of(event: Event, standing: Standing) -> tuple[int, str] | None:
    """Return level and text of an event; None for one that is no news by itself.

    Args:
        event: Of the engine.
        standing: Where the run stands, that event included.
    """
    kind = event.get("kind")
    if kind == "stage":
        return INFO, standing.stage
    if kind == "state":
        if standing.state in ENDING and standing.reason and not standing.completed:
            return ERROR, state_words(standing)
        return (WARNING if standing.state == PAUSED else INFO), state_words(standing)
    if kind == "step":
        return DEBUG, step_words(standing)
    if kind == "prompt":
        text = event.get("text", "")
        if not event.get("answered_by"):
            return WARNING, f"asking: {text}"
        return INFO, f"{answer_words(event)}: {text}"
    return None


# Lines of the event log.

MOST = 2000
"""Characters of one line; what files say was written by anybody."""


def words_of(event: Event, run: str) -> str:
    """Return one event of the log of `run`, for people."""
    words = _WORDS.get(str(event["kind"]), _any)
    try:
        text = words(event, run)
    except (KeyError, TypeError, ValueError):  # written by another version
        text = _any(event, run)
    return plain(text, most=MOST)


def _any(event: Event, run: str) -> str:
    details = {key: value for key, value in event.items() if key not in ("t", "time", "kind")}
    return " ".join([str(event["kind"]), *(f"{key}={value}" for key, value in details.items())])


def _interlocks(event: Event, run: str) -> str:
    each = (f"{one['name']} {one['limit'] or one['action']}" for one in event["watching"])
    return f"watched by interlocks: {', '.join(each)}"


def _dwell(event: Event, run: str) -> str:
    how = "settled" if event["settled"] else "did not settle"
    return f"step {event['step'] + 1}: dwell {how} in {event['elapsed_s']:.2f} s"


def _control(event: Event, run: str) -> str:
    reason = f": {event['reason']}" if event.get("reason") else ""
    refused = f" (not done: {event['problem']})" if event.get("problem") else ""
    return f"{event.get('who', 'somebody')} asked to {event['what']}{reason}{refused}"


def _weighing(event: Event, run: str) -> str:
    if event["result"] == "skipped":
        return f"loads are not weighed: {event['reason']}"
    load, why = event["load"], event.get("problem")
    if event["result"] == "first":
        return f"load {load} weighed: the others are compared with it"
    return f"load {load} weighed: {event['result']}" + (f": {why}" if why else "")


_WORDS: dict[str, Callable[[Event, str], str]] = {
    "interlocks": _interlocks,
    "state": lambda e, run: f"{e['state']}" + (f": {e['reason']}" if e.get("reason") else ""),
    "checkpoint": lambda e, run: f"step {e['step'] + 1}: checkpoint",
    "dwell": _dwell,
    "payload": lambda e, run: f"load {e['load']}: {e['mass_kg']:g} kg set",
    "asked": lambda e, run: f"asks: {e['text']} (answer: hil answer {run} yes)",
    "prompt": lambda e, run: answer_words(e),
    "paused": lambda e, run: f"paused: {e['reason']}",
    "resumed": lambda e, run: f"resumed by {e['by']}",
    "trip": lambda e, run: f"tripped: {e['reason']}",
    "control": _control,
    "weighing": _weighing,
}
