"""Clocks for the loop: that of the wall, and one that is put forward."""

from __future__ import annotations

import logging
import threading
from datetime import UTC, datetime, timedelta
from types import TracebackType
from typing import Any

AWAKE_EVERY = timedelta(seconds=60)
"""Longest sleep: a computer that was suspended, or whose clock was set, finds out after that."""

_GRACE_S = 12 * 3600
"""APScheduler would otherwise drop an alarm that is a second late."""


class VirtualClock:
    """A clock that sleeping puts forward.

    Args:
        moment: What it shows, with its time zone.
    """

    def __init__(self, moment: datetime) -> None:
        self._moment = moment.astimezone(UTC)

    def now(self) -> datetime:
        """What it shows, UTC."""
        return self._moment

    def sleep_until(self, moment: datetime) -> None:
        """Show that moment, unless it is past."""
        self._moment = max(self._moment, moment.astimezone(UTC))

    def advance(self, by: timedelta) -> None:
        """Show a later moment."""
        self._moment += by


class WallClock:
    """The computer's clock, with APScheduler to wake the thread that sleeps; a context manager.

    Work itself stays in the thread that sleeps: runs take signals, which reach the main thread
    alone.
    """

    def __init__(self) -> None:
        from apscheduler.schedulers.background import BackgroundScheduler

        logging.getLogger("apscheduler").setLevel(logging.ERROR)
        defaults = {"coalesce": True, "max_instances": 1, "misfire_grace_time": _GRACE_S}
        self._scheduler: Any = BackgroundScheduler(job_defaults=defaults, timezone=UTC)
        self._awake = threading.Event()

    def __enter__(self) -> WallClock:
        from apscheduler.events import EVENT_JOB_ERROR, EVENT_JOB_MISSED

        self._scheduler.add_listener(self._ring, EVENT_JOB_ERROR | EVENT_JOB_MISSED)
        self._scheduler.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._scheduler.shutdown(wait=False)

    def now(self) -> datetime:
        """UTC."""
        return datetime.now(UTC)

    def sleep_until(self, moment: datetime) -> None:
        """Sleep until then, a minute at most."""
        now = self.now()
        if moment <= now:
            return
        self._awake.clear()
        wakes = min(moment, now + AWAKE_EVERY)
        self._scheduler.add_job(
            self._ring, "date", run_date=wakes, id="next", replace_existing=True
        )
        self._awake.wait(AWAKE_EVERY.total_seconds())

    def _ring(self, event: object = None) -> None:
        self._awake.set()
