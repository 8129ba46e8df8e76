"""Progress display: one line that is replaced on a terminal, and separate lines in a pipe.

The class `ProgressLines` shows the progress of a complete run. The classes `ExcitationLine`,
`TrainingLine` and `StudyLine` show single parts of a run, also for verbs that execute only this
part. The class `WatchLines` shows the progress of a run of another process. All of these classes
write to a `MovingLine`.

News remains on the screen as separate lines: a stage, a pause and its reason, the end of a pause, a
prompt, the reason for a stop. A moving line begins with the most important text, because a narrow
terminal cuts off its end.
"""

from __future__ import annotations

import math
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Self, TextIO

from hil.cli.output import fold, width_of
from hil.core import Throttle, plain
from hil.engine import (
    ENDING,
    MOST,
    OWN,
    PAUSED,
    Event,
    Standing,
    answer_words,
    share_words,
    state_words,
    step_words,
    words_of,
)
from hil.report import duration

if TYPE_CHECKING:
    from hil.excitation import Advance
    from hil.networks import Told
    from hil.studies import Ended


class MovingLine:
    """Terminal line that is replaced in place; permanent lines are written above it.

    The moving line is never wrapped, but cut to the width of the terminal. At the end of its
    context, also after an error, the moving line is removed. In a pipe, only permanent lines are
    written.

    Args:
        stream: Output stream of the line; by default standard error.
        moves: Whether the stream is a terminal, on which the line can be replaced; by default
            detected from the stream.
    """

    def __init__(self, stream: TextIO | None = None, *, moves: bool | None = None) -> None:
        self._own_stream = stream
        self.moves = width_of(self._stream) is not None if moves is None else moves
        self._open = False

    @property
    def _stream(self) -> TextIO:
        return self._own_stream or sys.stderr

    def show(self, text: str) -> None:
        """Replace the text of the moving line; no effect in a pipe."""
        if not self.moves:
            return
        room = self._columns() - 1
        self._write(text if len(text) <= room else f"{text[: room - 1]}…")
        self._open = True

    def say(self, text: str) -> None:
        """Write a permanent line, wrapped between words on a terminal."""
        self._write((fold(text, self._columns()) if self.moves else text) + "\n")
        self._open = False

    def end(self, *, keep: bool = False) -> None:
        """Remove the moving line, or keep it and start a new line below it."""
        if self._open:
            self._stream.write("\n" if keep else "\r\x1b[K")
            self._stream.flush()
        self._open = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ending: object) -> None:
        self.end()

    def _write(self, text: str) -> None:
        start = "\r\x1b[K" if self._open else ""
        self._stream.write(start + text)
        self._stream.flush()

    def _columns(self) -> int:
        return width_of(self._stream) or max(20, shutil.get_terminal_size().columns)


PIPED_EVERY_S = 10.0
TERMINAL_EVERY_S = 0.1

ALIVE_EVERY_S = 120.0
"""Interval in a pipe between lines that only show that the process is still working [s]."""


class ProgressLines:
    """Observer of the engine that prints the progress of a run."""

    def __init__(self) -> None:
        self._line = MovingLine()
        self._standing = Standing()
        self._next = 0.0
        self._paused = False
        self._pausing = ""
        self._studies = StudyLine(self._line)
        self._excitation = ExcitationLine(self._line)
        self._training: TrainingLine | None = None

    def notify(self, event: Event) -> None:
        """Print an event if it is news; print the progress of the run at regular intervals."""
        self._standing.take(event)
        kind = event.get("kind")
        if kind == "study" and event.get("study"):
            self._studies.show(event["study"], event["what"], event["done"], event["total"])
        elif kind == "study_fit":
            from hil.studies import Ended

            self._studies.ended(event["study"], Ended(**event["ended"]))
        elif kind == "excitation":
            from hil.excitation import Advance

            self._excitation(Advance.from_event(event))
        elif kind == "training":
            from hil.networks import Told

            self._training = self._training or TrainingLine(_fit_words(event), self._line)
            self._training(Told(**event["epoch"]))
        else:
            self._of_the_run(event)

    def _of_the_run(self, event: Event) -> None:
        kind = event.get("kind")
        if kind == "study":  # end of the studies
            self._line.end()
        elif kind == "fit_note":
            self._line.say(f"{_fit_words(event)}: {event['text']}")
        elif kind == "fitted":
            self._training = None
            ended = _ended_words(_fit_words(event), event["seconds"], failed=event["failed"])
            self._line.say(ended)
        elif kind == "stage":
            self._line.say(f"{self._standing.stage} …")
        elif kind == "plan":
            for line in ("this run sweeps", *(f"  {line}" for line in event["lines"])):
                self._line.say(line)
        elif kind == "state":
            self._state()
        elif kind == "preflight":
            self._preflight(event)
        elif kind == "prompt":
            self._prompt(event)
        elif kind == "progress" or (kind == "step" and self._line.moves):
            self._announce()
            self._moving()

    def _state(self) -> None:
        run = self._standing
        was_paused, self._paused = self._paused, run.state == PAUSED
        if run.state == ENDING[0] and run.completed:
            self._line.say(_done(run))
        elif run.state in (PAUSED, ENDING[0]):
            self._line.say(state_words(run))
        elif was_paused:
            self._line.say(f"running again: {run.reason}" if run.reason else "running again")

    def _preflight(self, event: Event) -> None:
        """Print the waived checks and the checks of the driver, one per line."""
        checks = event.get("checks", [])
        self._line.say(f"preflight: {sum(bool(each['passed']) for each in checks)} checks passed")
        for each in checks:
            if each["waived"] or each["name"].startswith(OWN):
                waived = " (failed, waived)" if each["waived"] else ""
                self._line.say(f"  {each['name']}{waived}: {each['message']}")

    def _announce(self) -> None:
        """Confirm a requested pause immediately, because the next checkpoint may be far away."""
        question = self._standing.prompt
        if question and self._line.moves:
            return  # the console prints this and repeats the prompt
        before, self._pausing = self._pausing, self._standing.pausing
        if self._pausing and not before:
            moment = "after the answer to this prompt" if question else "at the next checkpoint"
            self._line.say(f"pausing {moment}: {self._pausing}")

    def _prompt(self, event: Event) -> None:
        # On a terminal the console prints the prompt, so the moving line must end first.
        if event.get("answered_by"):
            self._line.say(f"{answer_words(event)}: {event.get('text', '')}")
        elif self._line.moves:
            self._line.end(keep=True)
        else:
            self._line.say(f"prompt: {self._standing.prompt}")

    def _moving(self) -> None:
        run, now, moves = self._standing, time.monotonic(), self._line.moves
        if now < self._next or (run.prompt and moves) or run.state in ENDING:
            return
        self._next = now + (TERMINAL_EVERY_S if moves else PIPED_EVERY_S)
        (self._line.show if moves else self._line.say)(_progress(run))


def _fit_words(event: Event) -> str:
    return f"fit {event['number']} of {event['total']}: {event['estimator']}"


def _ended_words(fit: str, seconds: float, *, failed: bool = False) -> str:
    """Return the line about a finished fit, in the same format for runs and studies."""
    return f"{fit}{' failed' if failed else ''} ({duration(seconds)})"


def _progress(run: Standing) -> str:
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


FASTER_THAN_REAL = 1.5


def _speed(run: Standing) -> str:
    """Return how much faster than real time the run is; empty if the factor is small or unknown."""
    return f"{run.pace:.0f}× real time" if run.pace > FASTER_THAN_REAL else ""


class _Display:
    """Progress display of one part of a run; the line is removed at the end of the context."""

    def __init__(self, line: MovingLine | None = None) -> None:
        self._line = line or MovingLine()

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *ending: object) -> None:
        self._line.end()


class ExcitationLine(_Display):
    """Progress of the optimisation of trajectories; in a pipe, only the notes of the optimiser."""

    EVERY_S = 0.2

    def __init__(self, line: MovingLine | None = None) -> None:
        super().__init__(line)
        self._often = Throttle(self.EVERY_S, at_once=True)

    def __call__(self, advance: Advance) -> None:
        """Show the progress of the optimisation at regular intervals."""
        if advance.note:
            self._line.say(f"note: {advance.note}")
        elif self._line.moves and self._often.due():
            self._line.show(self._words(advance))

    @staticmethod
    def _words(advance: Advance) -> str:
        parts = [f"optimising trajectory {advance.trajectory}/{advance.trajectories}"]
        if advance.left_s is not None:
            parts.append(f"{duration(max(0.0, advance.left_s))} left")
        if math.isfinite(advance.best):
            parts.append(f"condition {advance.best:.1f}")
        parts.append(f"start {advance.start}/{advance.starts}")
        return "  ".join(parts)


class TrainingLine(_Display):
    """Progress of the training of a network, with its curve; in a pipe, one line at long intervals.

    The trainer calls this object with every epoch. If a fit trains several networks, the networks
    are shown one after the other.

    Args:
        fit: Text at the beginning of each line in a pipe, which identifies the fit.
        line: Moving line for the output; by default a new line.
    """

    EVERY_S = 0.2
    CURVE = 16
    """Width of the training curve [characters]."""

    def __init__(self, fit: str = "", line: MovingLine | None = None) -> None:
        super().__init__(line)
        self._fit = f"{fit}: " if fit else ""
        moves = self._line.moves
        self._often = Throttle(self.EVERY_S if moves else ALIVE_EVERY_S, at_once=moves)
        self._validation: list[float] = []
        self._since = (time.monotonic(), 0)
        """Time and number of the first epoch that this process trained."""

    def began(self, what: str) -> None:
        """Show the start of a training at once, also in a pipe; an epoch may take minutes."""
        self._show(what)

    def __call__(self, epoch: Told) -> None:
        """Show the training epoch at regular intervals."""
        from hil.networks import sparkline

        if not self._validation or epoch.epoch <= len(self._validation):
            self._validation = []
            self._since = (time.monotonic(), epoch.epoch)
        # A resumed training does not begin with epoch 1.
        missing = epoch.epoch - 1 - len(self._validation)
        self._validation += [epoch.validation] * (missing + 1)
        if not self._often.due():
            return
        parts = [
            f"epoch {epoch.epoch}/{epoch.epochs}",
            f"best {epoch.best:.4g}",
            sparkline(self._validation, self.CURVE),
        ]
        if (left_s := self._left_s(epoch)) is not None:
            parts.append(f"≤ {duration(left_s)} left")
        parts += [f"validation {epoch.validation:.4g}", f"loss {epoch.loss:.4g}", epoch.stage]
        self._show("  ".join(parts))

    def _show(self, text: str) -> None:
        if self._line.moves:
            self._line.show(text)
        else:
            self._line.say(f"{self._fit}{text}")

    def _left_s(self, epoch: Told) -> float | None:
        begin, first = self._since
        if epoch.epoch == first:
            return None
        return (time.monotonic() - begin) / (epoch.epoch - first) * (epoch.epochs - epoch.epoch)


class StudyLine(_Display):
    """Progress of studies; each finished fit of a study is a permanent line."""

    NEWS_EVERY_S = 1.0
    """Minimum time in a pipe between lines about different steps [s]."""

    def __init__(self, line: MovingLine | None = None) -> None:
        super().__init__(line)
        self._shown, self._done, self._since = "", -1, 0.0
        self._text = ""

    def show(self, study: str, what: str, done: int, total: int) -> None:
        """Show the progress of a study at regular intervals."""
        text, now = f"{study}: {what}", time.monotonic()
        if self._line.moves:
            wait = 0.0 if text != self._shown else TERMINAL_EVERY_S
        elif text != self._shown:
            wait = self.NEWS_EVERY_S
        else:
            wait = PIPED_EVERY_S if done != self._done else ALIVE_EVERY_S
        if now < self._since + wait:
            return
        self._shown, self._done, self._since = text, done, now
        share = f"{done}/{total}" if total else ""
        if self._line.moves:
            self._text = "  ".join(filter(None, (share, text)))
            self._line.show(self._text)
        else:
            self._line.say(f"{text} {share}".rstrip())

    def ended(self, study: str, ended: Ended) -> None:
        """Print a permanent line about a finished fit."""
        name = " ".join(filter(None, (ended.name, ended.failed)))
        fit = f"fit {ended.number} of {ended.total}: {name}"
        self._line.say(_ended_words(fit, ended.seconds))
        if self._text:  # the next update may take minutes
            self._line.show(self._text)


Item = Mapping[str, Any]


class WatchLines:
    """Printer for the items of `hil.workflow.follow`, which describe a run of another process.

    Args:
        run: Name of the run in the printed commands.
        terminal: Whether the output is a terminal, on which lines can be replaced.
        now: Monotonic clock [s].
    """

    SILENT_AFTER_S = 5.0

    QUIET = frozenset({"checkpoint", "dwell", "state", "payload"})
    """Kinds of events that are not printed as lines on a terminal, because the moving line shows
    them."""

    def __init__(
        self, run: str, *, terminal: bool, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._run = run
        self._line = MovingLine(sys.stdout, moves=terminal)
        self._now = now
        self._next = 0.0
        self._shown = ""

    def show(self, item: Item) -> None:
        """Print one item of news; print progress at regular intervals."""
        if item["kind"] == "event":
            event = item["event"]
            if not (self._line.moves and event["kind"] in self.QUIET):
                self.line(f"{_clock(event)}  {words_of(event, self._run)}")
        elif item["kind"] == "live":
            self._live(plain(live_line(item), most=MOST))
        elif item["kind"] == "end":
            self.line(end_line(item))

    def line(self, text: str) -> None:
        """Print a permanent line."""
        self._line.say(text)

    def _live(self, text: str) -> None:
        if self._line.moves:
            self._line.show(text)
        elif self._now() >= self._next and text != self._shown:
            self._next, self._shown = self._now() + PIPED_EVERY_S, text
            self.line(text)


def live_line(view: Item) -> str:
    """Return the present state of the run as one line."""
    from hil.workflow import standing_in

    run = standing_in(view)
    where = step_words(run) or run.stage or "preparing"
    if run.prompt:
        return f"prompt: {run.prompt}  {where}"
    if run.state in ENDING:
        return run.stage if run.state == "done" and run.stage else state_words(run)
    if run.state != "running":
        return "  ".join([state_words(run), *run.troubles, where])
    quiet = time.time() - float(view.get("t", 0.0))
    left = f"{duration(run.left_s)} left"
    if quiet > WatchLines.SILENT_AFTER_S:
        left = f"no news for {duration(quiet)}"
    return "  ".join([share_words(run), *run.troubles, where, left])


def end_line(end: Item) -> str:
    """Return the final status of the run and the next command."""
    text = f"{end['run']}: {end['status']}"
    if end["reason"]:
        text += f": {end['reason']}"
    if end["verdict"] != "not judged":
        text += f", model {end['verdict']}"
    if end["status"] != "completed":
        return f"{text}\n  next: hil resume {end['run']}"
    return text


def _clock(event: Item) -> str:
    try:
        return time.strftime("%H:%M:%S", time.localtime(float(event["t"])))
    except (KeyError, TypeError, ValueError, OverflowError):
        return "--:--:--"
