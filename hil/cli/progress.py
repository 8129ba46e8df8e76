"""Progress on stderr: one line that moves on a terminal, plain lines now and then in a pipe.

What is news stays on the screen as a line of its own: a stage, a pause and its reason, going on,
what the operator is asked, why the run stops. The moving line never wraps: it is cut to the width.
"""

from __future__ import annotations

import sys
import time

from hil.cli.excitation_line import ExcitationLine
from hil.cli.output import duration, fit_ended, fit_words, fold, width_of
from hil.cli.study_progress import StudyBar
from hil.cli.training_line import TrainingLine
from hil.engine import (
    ENDING,
    OWN,
    PAUSED,
    Event,
    Standing,
    answer_words,
    share_words,
    state_words,
    step_words,
)
from hil.excitation import Advance
from hil.networks import Told
from hil.studies import Ended

PIPED_EVERY_S = 10.0
TERMINAL_EVERY_S = 0.1
FASTER_THAN_REAL = 1.5


class ProgressLines:
    """An observer of the engine."""

    def __init__(self) -> None:
        self._tty = sys.stderr.isatty()
        self._standing = Standing()
        self._next = 0.0
        self._open = False
        self._paused = False
        self._pausing = ""
        self._studies = StudyBar()
        self._excitation = ExcitationLine()
        self._training: TrainingLine | None = None

    def notify(self, event: Event) -> None:
        """Print the event if it is news, and where the run stands if it is time to."""
        self._standing.take(event)
        kind = event.get("kind")
        if kind == "study" and event.get("study"):
            self._studies.show(event["study"], event["what"], event["done"], event["total"])
            return
        if kind == "study_fit":
            self._studies.ended(event["study"], Ended(**event["ended"]))
            return
        self._studies.end()
        if kind == "excitation":
            self._end_line()
            self._excitation(Advance.from_event(event))
            return
        self._excitation.end()
        if kind == "training":
            self._epoch(event)
            return
        if self._training:
            self._training.end()
        if kind == "fit_note":
            self._line(f"{fit_words(*_which(event))}: {event['text']}")
        elif kind == "fitted":
            self._training = None
            self._line(fit_ended(*_which(event), event["seconds"], failed=event["failed"]))
        elif kind == "stage":
            self._line(f"{self._standing.stage} …")
        elif kind == "plan":
            for line in ("this run sweeps", *(f"  {line}" for line in event["lines"])):
                self._line(line)
        elif kind == "state":
            self._state()
        elif kind == "preflight":
            self._preflight(event)
        elif kind == "prompt":
            self._prompt(event)
        elif kind == "progress" or (kind == "step" and self._tty):
            self._announce()
            self._moving()

    def _epoch(self, event: Event) -> None:
        self._end_line()
        self._training = self._training or TrainingLine(fit_words(*_which(event)))
        self._training(Told(**event["epoch"]))

    def _state(self) -> None:
        run = self._standing
        was_paused, self._paused = self._paused, run.state == PAUSED
        if run.state == ENDING[0] and run.completed:
            self._line(_done(run))
        elif run.state in (PAUSED, ENDING[0]):
            self._line(state_words(run))
        elif was_paused:
            self._line(f"running again: {run.reason}" if run.reason else "running again")

    def _preflight(self, event: Event) -> None:
        """What was waived, and what the robot has found out about itself, each on a line."""
        checks = event.get("checks", [])
        self._line(f"preflight: {sum(bool(each['passed']) for each in checks)} checks passed")
        for each in checks:
            if each["waived"] or each["name"].startswith(OWN):
                waived = " (failed, waived)" if each["waived"] else ""
                self._line(f"  {each['name']}{waived}: {each['message']}")

    def _announce(self) -> None:
        """Whoever asks for a pause hears at once that it was heard: a trajectory may take long."""
        asked = self._standing.prompt
        if asked and self._tty:
            return  # whoever asks says so, and asks again
        before, self._pausing = self._pausing, self._standing.pausing
        if self._pausing and not before:
            moment = "once the question is answered" if asked else "at the next checkpoint"
            self._line(f"pausing {moment}: {self._pausing}")

    def _prompt(self, event: Event) -> None:
        # On a terminal whoever asks prints the question; only the line must be out of its way.
        if event.get("answered_by"):
            self._line(f"{answer_words(event)}: {event.get('text', '')}")
        elif self._tty:
            self._end_line()
        else:
            self._line(f"asking: {self._standing.prompt}")

    def _moving(self) -> None:
        run, now = self._standing, time.monotonic()
        if now < self._next or (run.prompt and self._tty) or run.state in ENDING:
            return
        self._next = now + (TERMINAL_EVERY_S if self._tty else PIPED_EVERY_S)
        if (width := width_of(sys.stderr)) is None:
            self._line(_progress(run))
            return
        sys.stderr.write(f"\r\x1b[K{_cut(_progress(run), width - 1)}")
        sys.stderr.flush()
        self._open = True

    def _line(self, text: str) -> None:
        """A line that stays; on a terminal it is wrapped between words, in a pipe it is one."""
        start = "\r\x1b[K" if self._open else ""
        sys.stderr.write(f"{start}{fold(text, width_of(sys.stderr))}\n")
        sys.stderr.flush()
        self._open = False

    def _end_line(self) -> None:
        if self._open:
            sys.stderr.write("\n")
            sys.stderr.flush()
        self._open = False


def _which(event: Event) -> tuple[int, int, str]:
    return event["number"], event["total"], event["estimator"]


def _progress(run: Standing) -> str:
    """What matters most comes first: a narrow terminal cuts the end."""
    parts = [share_words(run)]
    if run.waits:
        parts += ["waiting for an answer" if run.prompt else state_words(run)]
    parts += [*run.troubles, step_words(run)]
    if not run.waits:
        parts += [f"{duration(run.left_s)} left" if run.duration_s else "", _speed(run)]
    return "  ".join(part for part in parts if part)


def _done(run: Standing) -> str:
    speed = _speed(run)
    parts = [
        "100 %",
        *run.troubles,
        f"{f'all {run.steps} steps, the rest' if run.resumed else f'{run.steps} steps'}"
        f" in {duration(run.wall_s)}",
        f"{duration(run.device_s)} of motion{f', {speed}' if speed else ''}",
    ]
    return "  ".join(parts)


def _speed(run: Standing) -> str:
    """How much faster than real time, once that can be said."""
    return f"{run.pace:.0f}× real time" if run.pace > FASTER_THAN_REAL else ""


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: max(0, width - 1)]}…"
