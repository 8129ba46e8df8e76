"""A schedule that is held does nothing until a person releases it.

It is held by a person, by what ended badly on the robot (somebody has to look before the arm moves
again), and by a clock that cannot be right.
"""

from __future__ import annotations

from datetime import datetime, timedelta

from hil.core import DataError, InterlockTripped, RobotConnectionError, RobotError, Stopped
from hil.maintenance.schedule.ledger import Ledger, Line, Standing, time_text
from hil.recording import operator

AHEAD = timedelta(days=1)
"""A ledger so far ahead of the clock was written with another clock; no time zone is so far off."""


def needs_a_look(error: Exception) -> bool:
    """Whether the reason may still stand at the robot: an interlock, a fault, somebody's hand.

    A robot that could not be reached is asked for itself before it moves again, and what failed
    without it (a fit, a disk) says nothing of it.
    """
    if isinstance(error, Stopped):
        return not error.by_signal
    if isinstance(error, RobotError):
        return not isinstance(error, RobotConnectionError)
    return isinstance(error, InterlockTripped)


def ahead(standing: Standing, now: datetime) -> str:
    """Why the clock cannot be right, or was not; empty where it may be."""
    if standing.until is None or standing.until <= now + AHEAD:
        return ""
    return (
        f"the clock shows {time_text(now)}, and everything is settled until "
        f"{time_text(standing.until)}: set the clock, or release the schedule from now on"
    )


def hold(ledger: Ledger, now: datetime, reason: str, by: str = "") -> Line:
    """Let nothing begin from now on; what is under way comes to its end.

    Args:
        ledger: Of the schedule.
        now: The moment.
        reason: In words.
        by: Who says so; by default the user of this process.

    Raises:
        DataError: It is held already.
        RegistryError: It cannot be written.
    """
    if (held := ledger.standing.held) is not None:
        raise DataError(
            f"the schedule is held already: {held['why']}", hint="hil schedule show FILE"
        )
    return ledger.add("held", now, why=reason, by=by or operator())


def release(ledger: Ledger, now: datetime, reason: str, by: str = "") -> Line:
    """Let it go on; from now on, where its ledger is ahead of the clock.

    Args:
        ledger: Of the schedule.
        now: The moment.
        reason: In words.
        by: Who says so; by default the user of this process.

    Raises:
        DataError: Nothing holds it.
        RegistryError: It cannot be written.
    """
    standing, again = ledger.standing, {}
    if standing.anchor is not None and ahead(standing, now):
        again = {"anchor": time_text(min(standing.anchor, now)), "until": time_text(now)}
    elif standing.held is None:
        raise DataError("the schedule is not held", hint="hil schedule show FILE")
    return ledger.add("released", now, why=reason, by=by or operator(), **again)
