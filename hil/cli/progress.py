"""Progress on stderr: one line that moves on a terminal, plain lines now and then in a pipe."""

from __future__ import annotations

import sys
import time

from hil.cli.output import duration
from hil.engine.observers import Event

PIPED_EVERY_S = 10.0
TERMINAL_EVERY_S = 0.2
SPEED_KNOWN_AFTER_S = 0.5
FASTER_THAN_REAL = 1.5


class ProgressLines:
    """An observer of the engine."""

    def __init__(self) -> None:
        self._tty = sys.stderr.isatty()
        self._next = 0.0
        self._open = False

    def notify(self, event: Event) -> None:
        """Print the event if it is time to."""
        if event["kind"] == "stage":
            self._line(f"{event['stage']} …")
        elif event["kind"] == "progress":
            self._progress(event)

    def _progress(self, event: Event) -> None:
        done = event["step"] + 1 == event["steps"]
        now = time.monotonic()
        if now < self._next and not done:
            return
        self._next = now + (TERMINAL_EVERY_S if self._tty else PIPED_EVERY_S)
        text = self._text(event)
        if self._tty and not done:
            sys.stderr.write(f"\r\x1b[K{text}")
            sys.stderr.flush()
            self._open = True
        else:
            self._line(text)

    def _line(self, text: str) -> None:
        start = "\r\x1b[K" if self._open else ""
        sys.stderr.write(f"{start}{text}\n")
        sys.stderr.flush()
        self._open = False

    @staticmethod
    def _text(event: Event) -> str:
        step, steps = event["step"] + 1, event["steps"]
        moved, wall = event["device_s"], event["wall_s"]
        head = f"step {step}/{steps} {event['doing']:<10} {duration(moved)} of motion"
        if step == steps:
            return f"100 %  {head}{_speed(moved, wall)}, took {duration(wall)}"
        # Dwells may take longer than planned: before its end no run is done.
        share = min(0.99, moved / max(event["duration_s"], 1e-9))
        # A virtual clock needs a moment to show its speed; before that the plan's own time stands.
        pace = moved / wall if wall > SPEED_KNOWN_AFTER_S else 1.0
        left = max(0.0, event["duration_s"] - moved) / max(pace, 1e-9)
        return f"{100 * share:3.0f} %  {head}{_speed(moved, wall)}, {duration(left)} left"


def _speed(moved_s: float, wall_s: float) -> str:
    """How much faster than real time, once that can be said."""
    if wall_s <= SPEED_KNOWN_AFTER_S or moved_s <= FASTER_THAN_REAL * wall_s:
        return ""
    return f" ({moved_s / wall_s:.0f}× real time)"
