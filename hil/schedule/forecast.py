"""A dry run: what would happen when, by the loop itself on a clock that is put forward."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from hil.schedule.clocks import VirtualClock
from hil.schedule.holding import ahead, release
from hil.schedule.ledger import Ledger, Line, occasion_of
from hil.schedule.loop import Scheduler
from hil.schedule.motions import Motions
from hil.schedule.occasion import Occasion
from hil.spec.durations import duration_text
from hil.spec.schedule import ScheduleSpec


@dataclass(frozen=True, slots=True)
class Expected:
    """Something that would happen.

    Attributes:
        due: When it is due, UTC; of several that are left out, the first.
        job: `probe` or `campaign`.
        what: `done` or `missed`.
        begins: When it would begin, None if it would not.
        motion: How long it would move the robot, were nothing found.
        why: Why it would not begin when it is due, or not at all; empty if it would.
        count: How many are left out for that reason.
        again: Whether it was begun before, and is gone on with.
    """

    due: datetime
    job: str
    what: str
    begins: datetime | None
    motion: timedelta
    why: str = ""
    count: int = 1
    again: bool = False

    def to_dict(self, zone: ZoneInfo) -> dict[str, Any]:
        """An entry of `hil schedule plan --json`; times are of the schedule's zone."""
        return {
            "due": self.due.astimezone(zone).isoformat(timespec="seconds"),
            "job": self.job,
            "what": self.what,
            "begins": self.begins and self.begins.astimezone(zone).isoformat(timespec="seconds"),
            "motion": duration_text(self.motion),
            "why": self.why,
            "count": self.count,
            "again": self.again,
        }


def forecast(
    spec: ScheduleSpec, ledger: Ledger, motions: Motions, now: datetime, end: datetime
) -> list[Expected]:
    """What would happen if the schedule ran from now on, the robot were free and nothing found.

    One that is held is looked at as if it were released now.

    Args:
        spec: The schedule.
        ledger: As it is now; nothing is written.
        motions: How long its programs move the robot.
        now: When it would be started.
        end: Of the time that is looked at.
    """
    clock = VirtualClock(now)
    imagined = Ledger(None, tuple(ledger.lines))
    if imagined.standing.held is not None or ahead(imagined.standing, now):
        release(imagined, now, "")
    known = len(imagined.lines)

    def work(occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        clock.advance(motions.expected(occasion.job))
        return {"outcome": "quiet", "text": ""}

    Scheduler(spec, imagined, work, clock, lasting=motions.longest).run(end)
    return _told(imagined.lines[known:], motions)


def _told(lines: list[Line], motions: Motions) -> list[Expected]:
    found, waits = [], ""
    for line in lines:
        if line["event"] == "deferred":
            waits = line["why"]
        elif line["event"] == "missed":
            first = occasion_of(line["since"])
            nothing = timedelta()
            told = (first.due, first.job, "missed", None, nothing, line["why"], line["count"])
            found.append(Expected(*told))
        elif line["event"] == "begun":
            one, at = occasion_of(line["occasion"]), datetime.fromisoformat(line["at"])
            long, again = motions.expected(one.job), bool(line.get("again"))
            found.append(Expected(one.due, one.job, "done", at, long, waits, 1, again))
            waits = ""
    return found
