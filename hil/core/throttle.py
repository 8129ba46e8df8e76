"""Rate limits for messages about events that occur frequently."""

from __future__ import annotations

import logging
import time
import traceback
from dataclasses import dataclass


class Throttle:
    """Rate limit that determines when the next message is due.

    Args:
        every_s: Minimum time between two messages [s].
        at_once: Whether the first message is due immediately; otherwise it is due after `every_s`.
    """

    def __init__(self, every_s: float, *, at_once: bool = True) -> None:
        self._every_s = every_s
        self._next = time.monotonic() + (0.0 if at_once else every_s)

    def due(self, *, anyway: bool = False) -> bool:
        """Return whether a message is due; if so, the next message is due after `every_s`.

        If `anyway` is true, a message is always due.
        """
        now = time.monotonic()
        if not anyway and now < self._next:
            return False
        self._next = now + self._every_s
        return True


class OncePerMinute(logging.Filter):
    """Log filter that passes one record per kind and minute, with the number of suppressed records.

    Log records with the same logger, template and exception type are of the same kind.

    Args:
        every_s: Minimum time between two records of the same kind [s]; one minute by default.
    """

    def __init__(self, every_s: float = 60.0) -> None:
        super().__init__()
        self._every_s = every_s
        self._kinds: dict[tuple[str, str, str], _Kind] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the log record is written."""
        kind = (record.name, str(record.msg), _origin(record))
        known = self._kinds.setdefault(kind, _Kind(Throttle(self._every_s)))
        if not known.throttle.due():
            known.left_out += 1
            return False
        if known.left_out:
            message = f"{record.getMessage()} ({known.left_out} more like it since the last line)"
            record.msg, record.args, known.left_out = message, (), 0
        return True


def _origin(record: logging.LogRecord) -> str:
    """Return type and position of a log record's exception; empty without an exception."""
    if not record.exc_info or record.exc_info[0] is None:
        return ""
    places = traceback.extract_tb(record.exc_info[2])[-1:]
    return f"{record.exc_info[0].__name__} {[(at.filename, at.lineno) for at in places]}"


@dataclass(slots=True)
class _Kind:
    throttle: Throttle
    left_out: int = 0
