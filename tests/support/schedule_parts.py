"""Schedules, and work that is done at once, for tests of the loop."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from itertools import takewhile
from pathlib import Path
from typing import Any

from hil.core.errors import FitError, RobotConnectionError, Stopped
from hil.maintenance.due_times import occasions
from hil.maintenance.ledger import Ledger, Occasion
from hil.maintenance.scheduler import Scheduler, VirtualClock
from hil.spec.schedule import ProbeJob, ScheduleSpec

MONDAY = datetime(2026, 11, 23, tzinfo=UTC)
HOUR, MINUTE = timedelta(hours=1), timedelta(minutes=1)


def schedule(**keys: Any) -> ScheduleSpec:
    """A daily probe at 03:00, unless something else is said."""
    daily: dict[str, Any] = {"spec": "probe.yaml", "cron": "0 3 * * *"}
    given = {"name": "nightly", "probe": daily, "campaign": {"spec": "campaign.yaml"}}
    return ScheduleSpec.model_validate({"hil_schedule": 1, **given, **keys})


def never_due() -> ScheduleSpec:
    """As if the last day of a calendar were past; a file is not accepted that says so."""
    job = ProbeJob.model_construct(spec="p", cron="0 0 31 feb *", every=None)
    return schedule().model_copy(update={"probe": job})


def at(text: str) -> datetime:
    """`23 03:00`: day and time of November 2026, UTC."""
    day, clock = text.split()
    hours, minutes = clock.split(":")
    return datetime(2026, 11, int(day), int(hours), int(minutes), tzinfo=UTC)


class Worker:
    """Work that takes some time of a virtual clock, and does what is said of an occasion."""

    def __init__(self, clock: VirtualClock, lasting: timedelta = MINUTE) -> None:
        self.clock, self.lasting = clock, lasting
        self.done: list[str] = []
        self.folders: list[Path] = []
        self.then: list[Callable[[], object]] = []

    def __call__(self, occasion: Occasion, folder: Path) -> Mapping[str, Any]:
        """Do it."""
        self.done.append(occasion.id)
        self.folders.append(folder)
        self.clock.advance(self.lasting)
        if self.then:
            self.then.pop(0)()
        return {"outcome": "quiet", "text": f"did {occasion.id}"}


def scheduler(
    spec: ScheduleSpec, start: datetime = MONDAY, ledger: Ledger | None = None, **parts: Any
) -> tuple[Scheduler, Worker, VirtualClock]:
    """A scheduler on a virtual clock, its work and its clock."""
    clock = VirtualClock(start)
    worker = Worker(clock)
    return Scheduler(spec, ledger or Ledger(), worker, clock, **parts), worker, clock


def events(ledger: Ledger) -> list[tuple[str, str]]:
    """Events and what they are about."""
    return [(line["event"], line.get("occasion", "")) for line in ledger.lines]


def raising(error: BaseException) -> Callable[[], object]:
    """Raises it when called."""

    def call() -> object:
        raise error

    return call


def anything_may_happen(seed: int, policy: str, parts: int = 6, hours: int = 20) -> None:
    """Robots that are busy, work that fails or is cut off, days off."""
    dice = random.Random(seed)
    spec = schedule(
        probe={"spec": "p", "every": f"{dice.choice((47, 90, 600))}min"},
        campaign={"spec": "c", "cron": "30 */7 * * *"},
        blackout=[{"begin": "08:00", "end": "18:00", "days": ["tue"]}],
        missed=policy, missed_within=dice.choice(("3h", "24h")),
    )  # fmt: skip
    ledger, now, busy = Ledger(), MONDAY, dice.random() * 0.8
    for _ in range(parts):
        ready = lambda: "busy" if dice.random() < busy else ""  # noqa: E731
        loop, worker, clock = scheduler(spec, now, Ledger(None, tuple(ledger.lines)), ready=ready)
        worker.lasting = dice.choice((MINUTE, 40 * MINUTE))
        errors = (FitError("no"), RobotConnectionError("no"), KeyboardInterrupt())
        worker.then = [raising(dice.choice(errors)) for _ in range(dice.randrange(3))]
        with suppress(Stopped):
            loop.run(now + dice.randrange(hours) * HOUR)
        ledger, now = loop.ledger, clock.now() + dice.choice((0, 1, 30, 100)) * HOUR
    require_accounts(spec, ledger)


def require_accounts(spec: Any, ledger: Ledger) -> None:
    """Every due time up to the last settled one ended once, and none was begun after its end."""
    standing = ledger.standing
    assert standing.anchor is not None
    assert standing.until is not None
    until = standing.until
    coming = occasions(spec, standing.anchor, standing.anchor - HOUR)
    wanted = [each.id for each in takewhile(lambda o: o.due <= until, coming)]
    ended: list[str] = []
    for line in ledger.lines:
        if line["event"] in ("done", "failed", "held"):
            ended.append(line["occasion"])
        elif line["event"] == "missed":
            ended += _left_out(wanted, line, ended, standing.open)
        elif line["event"] == "begun":
            assert line["occasion"] not in ended
    still = [standing.open.id] if standing.open else []
    assert sorted(ended + still) == sorted(wanted)


def _left_out(wanted: list[str], line: Any, ended: list[str], held: Occasion | None) -> list[str]:
    """Those between the first and the last that a line names, but for what it keeps."""
    keeps = {line.get("instead")} | set(ended)
    span = wanted[wanted.index(line["since"]) : wanted.index(line["occasion"]) + 1]
    left = [each for each in span if each not in keeps]
    assert len(left) == line["count"]
    return left
