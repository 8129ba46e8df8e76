"""Which of the things that are due is done, and which are left out; pure functions of the ledger.

What was begun is gone on with first. Of what else is due one occasion is done: the latest campaign,
or where none is due the latest probe; the others are left out in its favour, since a robot that is
looked at once need not be looked at twice. What was due too long ago is left out, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import takewhile

from hil.core import duration_text
from hil.maintenance.schedule.ledger import Standing
from hil.maintenance.schedule.occasion import Occasion
from hil.maintenance.schedule.times import occasions
from hil.spec import ScheduleSpec

PUNCTUAL = timedelta(minutes=10)
"""What begins so long after it was due is on time: timers call every few minutes only."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What is done about everything that is due.

    Attributes:
        late: Due too long ago, oldest first; left out.
        instead: Due, and left out in favour of what is chosen.
        chosen: What is to be done, None if nothing is.
        again: Whether that was begun before.
    """

    late: tuple[Occasion, ...] = ()
    instead: tuple[Occasion, ...] = ()
    chosen: Occasion | None = None
    again: bool = False


def choose(
    spec: ScheduleSpec, standing: Standing, now: datetime, due_by: datetime | None = None
) -> Choice:
    """What is done at a moment.

    Args:
        spec: The schedule.
        standing: Of its ledger, which has been started.
        now: The moment.
        due_by: What is due later waits; by default that moment.
    """
    latest = now - lateness(spec)
    if standing.begun and standing.open is not None:
        touched = standing.touched or standing.open.due
        if touched < now - spec.missed_within:
            return Choice(late=(standing.open,))
        return Choice(chosen=standing.open, again=True)
    due = (*((standing.open,) if standing.open else ()), *due_until(spec, standing, due_by or now))
    late = tuple(each for each in due if each.due < latest)
    timely = [each for each in due if each.due >= latest]
    if not timely:
        return Choice(late)
    chosen = max(timely, key=lambda each: (each.job == "campaign", each.due))
    return Choice(late, tuple(each for each in timely if each != chosen), chosen)


def due_until(spec: ScheduleSpec, standing: Standing, now: datetime) -> Sequence[Occasion]:
    """What is due up to `now` and not settled, oldest first, without what is open."""
    assert standing.anchor is not None
    assert standing.until is not None
    coming = occasions(spec, standing.anchor, standing.until)
    return list(takewhile(lambda each: each.due <= now, coming))


def lateness(spec: ScheduleSpec) -> timedelta:
    """How long after it was due something may begin."""
    return spec.missed_within if spec.missed == "run" else PUNCTUAL


def late_words(spec: ScheduleSpec, standing: Standing, late: Sequence[Occasion]) -> str:
    """Why those are left out."""
    limit = duration_text(spec.missed_within)
    if standing.begun and list(late) == [standing.open]:
        return f"begun, and not gone on with within {limit}"
    because = f", {standing.why}" if standing.open in late and standing.why else ""
    if spec.missed == "skip":
        return f"it could not be done on time{because}"
    return f"it could not be done within {limit}{because}"
