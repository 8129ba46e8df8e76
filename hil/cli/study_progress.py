"""How far a study is: a bar on a terminal, plain lines now and then in a pipe."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

from hil.cli.output import fit_ended

if TYPE_CHECKING:
    from rich.progress import Progress

    from hil.studies import Ended

PIPED_EVERY_S = 10.0
NEWS_EVERY_S = 1.0
"""In a pipe, what is done next is told at once, but not more often than this [s]."""

ALIVE_EVERY_S = 120.0
"""In a pipe, a line that says the same again only shows that work goes on [s]."""


class StudyBar:
    """Progress of studies on stderr; `end` takes the bar off the screen."""

    def __init__(self) -> None:
        self._tty = sys.stderr.isatty()
        self._bar: Progress | None = None
        self._told, self._done, self._since = "", -1, 0.0

    def show(self, study: str, what: str, done: int, total: int) -> None:
        """Show where a study is."""
        if self._tty:
            self._move(f"{study}: {what}", done, total)
        else:
            self._line(f"{study}: {what}", done, total)

    def ended(self, study: str, ended: Ended) -> None:
        """Leave a line for a fit that is done, above the bar."""
        name = " ".join(filter(None, (ended.name, ended.failed)))
        text = fit_ended(ended.number, ended.total, name, ended.seconds)
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            sys.stderr.write(f"{text}\n")
            sys.stderr.flush()

    def end(self) -> None:
        """Take the bar away; the next `show` makes a new one."""
        if self._bar is not None:
            self._bar.stop()
        self._bar, self._told = None, ""

    def _move(self, text: str, done: int, total: int) -> None:
        if self._bar is None:
            self._bar = _bar()
            self._bar.start()
        if text != self._told:
            for task in self._bar.task_ids:
                self._bar.remove_task(task)
            self._bar.add_task(text, total=total or None)
        self._told = text
        self._bar.update(self._bar.task_ids[-1], completed=done, total=total or None)

    def _line(self, text: str, done: int, total: int) -> None:
        now = time.monotonic()
        wait = PIPED_EVERY_S if done != self._done else ALIVE_EVERY_S
        if now < self._since + (wait if text == self._told else NEWS_EVERY_S):
            return
        self._told, self._done, self._since = text, done, now
        sys.stderr.write(f"{text} {f'{done}/{total}' if total else ''}".rstrip() + "\n")
        sys.stderr.flush()


def _bar() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    # The text gives way in a narrow terminal; a bracket in it is no markup.
    room = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    return Progress(
        TextColumn("{task.description}", markup=False, table_column=room),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        expand=True,
        refresh_per_second=4,
    )
