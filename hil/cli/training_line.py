"""How far the training of a network is: one line with its curve, now and then one in a pipe."""

from __future__ import annotations

import sys
import time

from hil.cli.output import duration, width_of
from hil.core import Throttle
from hil.networks import Told, sparkline

EVERY_S = 0.2
ALIVE_EVERY_S = 120.0
"""In a pipe, a line that only shows that work goes on [s]."""

CURVE = 16


class TrainingLine:
    """Called with every epoch; a fit that trains several networks shows one after the other.

    Use it as a context: the line is taken away at the end, however that comes.

    Args:
        fit: Begins the lines in a pipe: which fit it is.
    """

    def __init__(self, fit: str = "") -> None:
        self._fit = f"{fit}: " if fit else ""
        tty = width_of(sys.stderr) is not None
        self._often = Throttle(EVERY_S if tty else ALIVE_EVERY_S, at_once=tty)
        self._open = False
        self._validation: list[float] = []
        self._since = (time.monotonic(), 0)
        """When the first epoch was told that this process trained, and its number."""

    def began(self, what: str) -> None:
        """Show it at once, in a pipe too: without it there would be nothing for minutes."""
        self._show(what)

    def __call__(self, told: Told) -> None:
        """Show it, if it is time to."""
        if not self._validation or told.epoch <= len(self._validation):
            self._validation = []
            self._since = (time.monotonic(), told.epoch)
        # A training that is taken up again begins with a later epoch than the first.
        missing = told.epoch - 1 - len(self._validation)
        self._validation += [told.validation] * (missing + 1)
        if self._often.due():
            self._show(words(told, sparkline(self._validation, CURVE), self._left_s(told)))

    def _show(self, line: str) -> None:
        if (width := width_of(sys.stderr)) is None:
            sys.stderr.write(f"{self._fit}{line}\n")
        else:
            sys.stderr.write(f"\r\x1b[K{line if len(line) < width else line[: width - 2] + '…'}")
            self._open = True
        sys.stderr.flush()

    def _left_s(self, told: Told) -> float | None:
        begin, first = self._since
        if told.epoch == first:
            return None
        return (time.monotonic() - begin) / (told.epoch - first) * (told.epochs - told.epoch)

    def end(self) -> None:
        """Take the line away."""
        if self._open:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
        self._open = False

    def __enter__(self) -> TrainingLine:
        return self

    def __exit__(self, *ending: object) -> None:
        self.end()


def words(told: Told, curve: str, left_s: float | None) -> str:
    """What matters most comes first: a narrow terminal cuts the end."""
    parts = [f"epoch {told.epoch}/{told.epochs}", f"best {told.best:.4g}", curve]
    if left_s is not None:
        parts.append(f"≤ {duration(left_s)} left")
    parts += [f"validation {told.validation:.4g}", f"loss {told.loss:.4g}", told.stage]
    return "  ".join(parts)
