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
        done, total, wall = event["device_s"], event["duration_s"], event["wall_s"]
        share = min(1.0, done / max(total, 1e-9))
        # A virtual clock needs a moment to show its speed; before that the plan's own time stands.
        speed = done / wall if wall > SPEED_KNOWN_AFTER_S else 1.0
        fast = f" ({speed:.0f}× real time)" if speed > FASTER_THAN_REAL else ""
        left = max(0.0, total - done) / max(speed, 1e-9)
        return (
            f"{100 * share:3.0f} %  step {event['step'] + 1}/{event['steps']} {event['doing']:<10} "
            f"{duration(done)} of motion{fast}, {duration(left)} left"
        )
