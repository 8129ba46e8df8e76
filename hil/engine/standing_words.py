"""What the events of a run say, in words and with the level of a log line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hil.engine.standing import ENDING, PAUSED, Standing

DEBUG, INFO, WARNING, ERROR = 10, 20, 30, 40
"""Levels of `rcl_interfaces/msg/Log`."""


def words_of(event: Mapping[str, Any], standing: Standing) -> tuple[int, str] | None:
    """Level and text of an event; None for one that is no news by itself.

    Args:
        event: Of the engine.
        standing: Where the run stands, that event included.
    """
    kind = event.get("kind")
    if kind == "stage":
        return INFO, standing.stage
    if kind == "state":
        return _state_level(standing), state_words(standing)
    if kind == "step":
        return DEBUG, step_words(standing)
    if kind == "prompt":
        text = event.get("text", "")
        if not event.get("answered_by"):
            return WARNING, f"asking: {text}"
        return INFO, f"{answer_words(event)}: {text}"
    return None


def answer_words(event: Mapping[str, Any]) -> str:
    """`answered by anna`, or `anna answered no`: that ends the run."""
    who = event.get("answered_by") or "nobody"
    return f"{who} answered no" if event.get("answer") == "no" else f"answered by {who}"


def state_words(standing: Standing) -> str:
    """`paused: interlock temperature: …`."""
    return f"{standing.state}: {standing.reason}" if standing.reason else standing.state


def step_words(standing: Standing) -> str:
    """`step 12/650 dwell, pose 5`; nothing before the first one."""
    if not standing.steps:
        return ""
    if standing.step < 0:  # what a resumed run does before it goes on
        return "on the way back"
    of = [f"{what} {i}" for what, i in _of_what(standing) if i >= 0]
    doing = ", ".join([standing.doing, *of]) if standing.doing else ""
    return f"step {standing.step + 1}/{standing.steps} {doing}".rstrip()


def share_words(standing: Standing) -> str:
    """` 12 %`; of a run that was gone on with ` 12 % of what was left`."""
    of = " of what was left" if standing.resumed else ""
    return f"{100 * standing.share:3.0f} %{of}"


def _of_what(standing: Standing) -> tuple[tuple[str, int], ...]:
    load = standing.load if standing.doing in ("payload", "weigh") else -1
    return ("pose", standing.pose), ("trajectory", standing.trajectory), ("load", load)


def _state_level(standing: Standing) -> int:
    if standing.state in ENDING and standing.reason and not standing.completed:
        return ERROR
    return WARNING if standing.state == PAUSED else INFO
