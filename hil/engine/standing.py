"""Progress of a run, and text descriptions of its progress and events.

`Standing` accumulates the events published by the engine into one state. Terminal, live file,
dashboard and network view each have a `Standing` and describe it with the same functions, so that
they all show the same text. Events can be incomplete or from an older version: a missing key leaves
the state unchanged.

Two functions convert events to text. `message_of` converts events received by observers, such as
`{"kind": "step", …}`; `words_of` converts the lines of `events.jsonl`, which contain more data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from hil.core import plain

PACE_KNOWN_AFTER_S = 0.5
"""Wall time after which the speed of a virtual clock is measured accurately enough [s]; before
this time, a speed of 1 is used."""

BEHIND_SHOWN_S = 0.5
"""Minimum delay of the recorder that is reported [s]."""

PAUSED = "paused"
ENDING = ("stopping", "done")

Event = Mapping[str, Any]


@dataclass(slots=True)
class Standing:
    """Accumulated progress of a run.

    Attributes:
        stage: Stage of the experiment: planning, running or fitting.
        state, reason: State of the engine, and the reason for this state.
        step, steps: Index of the current step, and the total number of steps.
        doing, pose, trajectory, load: Kind of the current step, and the indices of its pose,
            trajectory and load; −1 if the step has none.
        device_s, wall_s: Device time and wall time since the run began [s].
        duration_s: Planned duration of the run without pauses and prompts [s].
        samples, gaps, missing, duplicates, overruns: Counts for the recorded topic of the robot
            state.
        behind_s: Delay of the recorder behind the robot [s].
        pausing: Reason for the pause at the next checkpoint; empty if no pause is requested.
        prompt: Question to the operator that is open now; empty if no question is open.
        asked: Number of the newest question to the operator in this attempt, counted from 1; 0 if
            unknown.
        paused_s: Device time spent in pauses or at prompts [s].
        resumed: 1 if the run was resumed, so that times and shares refer to the remaining plan;
            otherwise 0.
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
        """Update the state from an event; missing keys and unknown kinds change nothing."""
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
                # NaN before the first sample
                if not isinstance(value, float) or math.isfinite(value):
                    setattr(self, name, value)
            if self.waits:
                self.paused_s += max(0.0, self.device_s - before)

    @property
    def waits(self) -> bool:
        """Whether the measuring program is waiting, because of a pause or an open question."""
        return self.state == PAUSED or bool(self.prompt)

    @property
    def completed(self) -> bool:
        """Whether the measuring program is complete: the run ended without a stop reason."""
        return self.state in ENDING and self.reason in ("", "completed") and self.steps > 0

    @property
    def moved_s(self) -> float:
        """Device time of the measuring program without pauses and prompts [s]."""
        return max(0.0, self.device_s - self.paused_s)

    @property
    def share(self) -> float:
        """Completed share of the measuring program, 0 to 1; below 1 until the run is completed.

        The share is at most 0.99 before the run is completed.
        """
        if self.completed:
            return 1.0
        # Dwells can take longer than planned, so the share is below 1 before the end.
        return min(0.99, self.moved_s / self.duration_s) if self.duration_s > 0 else 0.0

    @property
    def pace(self) -> float:
        """Device time per wall time; at least 1, because the start of a run is slow."""
        if self.wall_s > PACE_KNOWN_AFTER_S:
            return max(1.0, self.device_s / self.wall_s)
        return 1.0

    @property
    def left_s(self) -> float:
        """Expected wall time until the measuring program ends without interruptions [s]."""
        return 0.0 if self.completed else max(0.0, self.duration_s - self.moved_s) / self.pace

    @property
    def troubles(self) -> list[str]:
        """Descriptions of the problems of the recording; empty if there are no problems.

        Late samples are not described as a problem, because no late sample is lost and a busy
        computer causes many late samples.
        """
        missing = f" ({self.missing} samples missing)" if self.missing else ""
        said = [
            _count(self.gaps, "gap") + missing if self.gaps else "",
            _count(self.duplicates, "duplicate"),
            f"recorder {self.behind_s:.1f} s behind" if self.behind_s > BEHIND_SHOWN_S else "",
        ]
        return [text for text in said if text]

    def snapshot(self) -> dict[str, Any]:
        """Return the complete progress state as a JSON object."""
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
    """Return the state of the engine and its reason, such as `paused: interlock temperature: …`."""
    return f"{standing.state}: {standing.reason}" if standing.reason else standing.state


def share_words(standing: Standing) -> str:
    """Return the completed share of the run as text, such as ` 12 %`.

    The text of a resumed run is ` 12 % of the remaining plan`.
    """
    of = " of the remaining plan" if standing.resumed else ""
    return f"{100 * standing.share:3.0f} %{of}"


def step_words(standing: Standing) -> str:
    """Return the current step as text, such as `step 12/650 dwell, pose 5`.

    The text is empty before the first step.
    """
    if not standing.steps:
        return ""
    if standing.step < 0:  # steps of a resumed run before its remaining plan
        return "returning to the plan"
    load = standing.load if standing.doing in ("payload", "weigh") else -1
    subjects = (("pose", standing.pose), ("trajectory", standing.trajectory), ("load", load))
    of = [f"{what} {i}" for what, i in subjects if i >= 0]
    doing = ", ".join([standing.doing, *of]) if standing.doing else ""
    return f"step {standing.step + 1}/{standing.steps} {doing}".rstrip()


def answer_words(event: Event) -> str:
    """Return `answered by anna`, or `anna answered no` for an answer that ends the run."""
    who = event.get("answered_by") or "no operator"
    return f"{who} answered no" if event.get("answer") == "no" else f"answered by {who}"


# Events received by observers.

DEBUG, INFO, WARNING, ERROR = 10, 20, 30, 40
"""Numbers of the log levels of `rcl_interfaces/msg/Log`."""


def message_of(event: Event, standing: Standing) -> tuple[int, str] | None:
    """Return log level and text of an event; None for an event that is not displayed as text.

    Args:
        event: Event published by the engine.
        standing: Progress of the run after the event.
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
"""Maximum number of characters of a displayed line, because the content of files is not trusted."""


def words_of(event: Event, run: str) -> str:
    """Return a readable text for one event in the event log of `run`."""
    words = _WORDS.get(str(event["kind"]), _any)
    try:
        text = words(event, run)
    except (KeyError, TypeError, ValueError):  # written by a different version
        text = _any(event, run)
    return plain(text, most=MOST)


def _any(event: Event, run: str) -> str:
    details = {key: value for key, value in event.items() if key not in ("t", "time", "kind")}
    return " ".join([str(event["kind"]), *(f"{key}={value}" for key, value in details.items())])


def _interlocks(event: Event, run: str) -> str:
    each = (f"{one['name']} {one['limit'] or one['action']}" for one in event["watching"])
    return f"active interlocks: {', '.join(each)}"


def _dwell(event: Event, run: str) -> str:
    how = "settled" if event["settled"] else "did not settle"
    return f"step {event['step'] + 1}: dwell {how} in {event['elapsed_s']:.2f} s"


def _control(event: Event, run: str) -> str:
    reason = f": {event['reason']}" if event.get("reason") else ""
    refused = f" (refused: {event['problem']})" if event.get("problem") else ""
    return f"request from {event.get('who', 'an unknown client')}: {event['what']}{reason}{refused}"


def _weighing(event: Event, run: str) -> str:
    if event["result"] == "skipped":
        return f"no payload check: {event['reason']}"
    load, why = event["load"], event.get("problem")
    if event["result"] == "first":
        return f"payload check of load {load}: reference for the other loads"
    return f"payload check of load {load}: {event['result']}" + (f": {why}" if why else "")


_WORDS: dict[str, Callable[[Event, str], str]] = {
    "interlocks": _interlocks,
    "state": lambda e, run: f"{e['state']}" + (f": {e['reason']}" if e.get("reason") else ""),
    "checkpoint": lambda e, run: f"step {e['step'] + 1}: checkpoint",
    "dwell": _dwell,
    "payload": lambda e, run: f"load {e['load']}: {e['mass_kg']:g} kg set",
    "asked": lambda e, run: f"question: {e['text']} (answer: hil answer {run} yes)",
    "prompt": lambda e, run: answer_words(e),
    "paused": lambda e, run: f"paused: {e['reason']}",
    "resumed": lambda e, run: f"resumed by {e['by']}",
    "trip": lambda e, run: f"tripped: {e['reason']}",
    "control": _control,
    "weighing": _weighing,
}
