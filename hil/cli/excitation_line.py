"""How far the optimisation of trajectories is: one line that moves on a terminal, else nothing."""

from __future__ import annotations

import math
import sys
import time

from hil.cli.output import duration, fold, width_of
from hil.excitation import Advance

EVERY_S = 0.2


class ExcitationLine:
    """Called with every advance; notes stay on the screen, in a pipe too.

    Use it as a context: the line is taken away at the end, however that comes.
    """

    def __init__(self) -> None:
        self._next = 0.0
        self._open = False

    def __call__(self, advance: Advance) -> None:
        """Show it, if it is time to."""
        if advance.note:
            self.end()
            sys.stderr.write(f"{fold(f'note: {advance.note}', width_of(sys.stderr))}\n")
        elif (width := width_of(sys.stderr)) is not None and time.monotonic() >= self._next:
            self._next = time.monotonic() + EVERY_S
            sys.stderr.write(f"\r\x1b[K{_cut(words(advance), width - 1)}")
            self._open = True
        sys.stderr.flush()

    def end(self) -> None:
        """Take the line away."""
        if self._open:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
        self._open = False

    def __enter__(self) -> ExcitationLine:
        return self

    def __exit__(self, *ending: object) -> None:
        self.end()


def words(advance: Advance) -> str:
    """What matters most comes first: a narrow terminal cuts the end."""
    parts = [f"optimising trajectory {advance.trajectory}/{advance.trajectories}"]
    if advance.left_s is not None:
        parts.append(f"{duration(max(0.0, advance.left_s))} left")
    if math.isfinite(advance.best):
        parts.append(f"condition {advance.best:.1f}")
    parts.append(f"start {advance.start}/{advance.starts}")
    return "  ".join(parts)


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: max(0, width - 1)]}…"
