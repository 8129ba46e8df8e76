"""What `hil watch` prints: one line that moves on a terminal, plain lines in a pipe."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from hil.cli.output import duration, fold
from hil.core import plain
from hil.engine import ENDING, MOST, Standing, share_words, state_words, step_words, words_of
from hil.workflow import standing_in

PIPED_EVERY_S = 10.0
SILENT_AFTER_S = 5.0
Item = Mapping[str, Any]

QUIET = frozenset({"checkpoint", "dwell", "state", "payload"})
"""Events that a terminal shows in its moving line, if at all."""


class WatchLines:
    """Prints the items of `hil.workflow.following.follow`.

    Args:
        run: What to call the run in commands.
        terminal: Whether lines can be replaced.
        now: Monotonic clock [s].
    """

    def __init__(
        self, run: str, *, terminal: bool, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._run = run
        self._terminal = terminal
        self._now = now
        self._next = 0.0
        self._open = False
        self._shown = ""

    def show(self, item: Item) -> None:
        """Print one item, if it is time to."""
        if item["kind"] == "event":
            event = item["event"]
            if not (self._terminal and event["kind"] in QUIET):
                self.line(f"{_clock(event)}  {words_of(event, self._run)}")
        elif item["kind"] == "live":
            self._live(plain(live_line(item), most=MOST))
        elif item["kind"] == "end":
            self.line(end_line(item))

    def line(self, text: str) -> None:
        """Print a line that stays; a terminal wraps it between words, a pipe gets it whole."""
        text = fold(text, _width()) if self._terminal else text
        sys.stdout.write(f"{self._clear()}{text}\n")
        sys.stdout.flush()

    def _live(self, text: str) -> None:
        if self._terminal:
            sys.stdout.write(f"{self._clear()}{text[: _width()]}")
            sys.stdout.flush()
            self._open = True
        elif self._now() >= self._next and text != self._shown:
            self._next, self._shown = self._now() + PIPED_EVERY_S, text
            self.line(text)

    def _clear(self) -> str:
        start, self._open = "\r\x1b[K" if self._open else "", False
        return start


def live_line(view: Item) -> str:
    """Where the run is, on one line; what matters most comes first."""
    run = standing_in(view)
    where = step_words(run) or run.stage or "preparing"
    if run.prompt:
        return f"asks: {run.prompt}  {where}"
    if run.state in ENDING:
        return run.stage if run.state == "done" and run.stage else state_words(run)
    if run.state != "running":
        return "  ".join([state_words(run), *run.troubles, where])
    parts = [share_words(run), *run.troubles, where, _left(view, run)]
    return "  ".join(parts)


def end_line(end: Item) -> str:
    """How the run ended, and what to do next."""
    text = f"{end['run']}: {end['status']}"
    if end["reason"]:
        text += f": {end['reason']}"
    if end["verdict"] != "not judged":
        text += f", model {end['verdict']}"
    if end["status"] != "completed":
        return f"{text}\n  next: hil resume {end['run']}"
    return text


def _left(view: Item, run: Standing) -> str:
    quiet = time.time() - float(view.get("t", 0.0))
    if quiet > SILENT_AFTER_S:
        return f"no news for {duration(quiet)}"
    return f"{duration(run.left_s)} left"


def _width() -> int:
    """Columns that a line may have; one less than there are, so that it can be replaced."""
    return max(20, shutil.get_terminal_size().columns - 1)


def _clock(event: Item) -> str:
    try:
        return time.strftime("%H:%M:%S", time.localtime(float(event["t"])))
    except (KeyError, TypeError, ValueError, OverflowError):
        return "--:--:--"
