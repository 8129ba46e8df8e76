"""The loop of a schedule: what is due is done, once, and written down.

It works on a clock, so that simulations, dry runs and tests have one of their own. Due times are
computed from that clock every time: a computer that slept, or whose clock was set, is no matter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Protocol

from hil.core import HilError, RobotConnectionError, Stopped
from hil.maintenance.schedule.choosing import choose, late_words, lateness
from hil.maintenance.schedule.holding import ahead, needs_a_look
from hil.maintenance.schedule.ledger import Ledger, time_text
from hil.maintenance.schedule.occasion import Job, Occasion, Work
from hil.maintenance.schedule.times import Window, next_free, occasions, window_in
from hil.spec import ScheduleSpec

LOOK_AGAIN = timedelta(seconds=60)
"""What was put off for the robot's sake is tried again so often."""

WEEK = timedelta(days=8)
"""Nothing takes so long; a blackout after that ends nothing."""

Line = Mapping[str, Any]


class Clock(Protocol):
    """What time it is."""

    def now(self) -> datetime:
        """Now, with its time zone."""

    def sleep_until(self, moment: datetime) -> None:
        """Wait; may return early."""


class Interruption(Exception):
    """Work was interrupted because a blackout began."""


Guard = Callable[[datetime | None], AbstractContextManager[None]]
"""Ends what is done inside when a moment comes, by raising `Interruption`."""


@dataclass
class Scheduler:
    """Does what is due.

    Args:
        spec: The schedule.
        ledger: Of its state, kept by this process alone.
        work: What is done.
        clock: What time it is.
        lasting: How long an occasion takes at most, for blackouts.
        ready: Why the robot cannot be used now; empty when it can.
        guard: Ends work when a blackout begins.
        tell: Is told every line of the ledger.
        notify: Is told what came of an occasion; returns why it could not be, or nothing.
        failure: What the last occasion failed of, None if it did not.
    """

    spec: ScheduleSpec
    ledger: Ledger
    work: Work
    clock: Clock
    lasting: Callable[[Job], timedelta] = lambda job: timedelta()
    ready: Callable[[], str] = lambda: ""
    guard: Guard = lambda moment: nullcontext()
    tell: Callable[[Line], object] = lambda line: None
    notify: Callable[[Line], str] = lambda line: ""
    failure: HilError | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.ledger.start(self.spec.name, self.clock.now())

    def run(self, end: datetime | None = None) -> None:
        """Do what is due whenever it is, to an end if there is one.

        Raises:
            Stopped: A signal came; what was begun is gone on with at the next start.
            DataError, RecordingError, RegistryError: The ledger cannot be kept.
        """
        try:
            while end is None or self.clock.now() < end:
                self.run_due(end)
                moments = [each for each in (self.next_moment(), end) if each is not None]
                if not moments:
                    return
                self.clock.sleep_until(min(moments))
        except KeyboardInterrupt:
            raise Stopped(
                "stopped between two occasions", by_signal=True, hint="hil schedule run goes on"
            ) from None

    def run_once(self) -> None:
        """Do what is due at this moment, as far as it can be done; what comes due meanwhile waits.

        Raises:
            Stopped, DataError, RecordingError, RegistryError: See `run`.
        """
        due_by = self.clock.now()
        while self._one(due_by):
            pass

    def run_due(self, end: datetime | None = None) -> None:
        """Do everything that is due now, as far as it can be done now, and before `end`.

        What takes longer than its interval is always due again.

        Raises:
            Stopped, DataError, RecordingError, RegistryError: See `run`.
        """
        while (end is None or self.clock.now() < end) and self._one():
            pass

    def next_moment(self) -> datetime | None:
        """When something may have to be done again; None if never."""
        standing, now = self.ledger.standing, self.clock.now()
        assert standing.anchor is not None
        assert standing.until is not None
        if standing.held is not None:  # until then somebody may have released it
            return now + LOOK_AGAIN
        # What came due beside something that is open waits for it, and is no reason to wake.
        after = max(now, standing.until) if standing.open else standing.until
        coming = next(occasions(self.spec, standing.anchor, after), None)
        moments = [coming.due] if coming is not None else []
        if standing.open is not None:
            free, window = next_free(self.spec, now, self.lasting(standing.open.job))
            moments.append(free if window and free else now + LOOK_AGAIN)
        return min(moments, default=None)

    def _one(self, due_by: datetime | None = None) -> bool:
        """Do what is most due, now or by some moment; returns whether there may be more."""
        self.ledger.refresh()
        now, standing = self.clock.now(), self.ledger.standing
        due_by = min(due_by or now, now)
        if standing.held is None and (why := ahead(standing, now)):
            self._announce(self._note("held", why=why))
        if self.ledger.standing.held is not None:
            return False
        choice = choose(self.spec, standing, now, due_by)
        if choice.late:
            why = late_words(self.spec, standing, choice.late)
            self._leave_out(choice.late, why, choice.late[-1].due)
        if choice.chosen is None:
            return bool(choice.late)
        # What was begun was chosen before: others that became due since are still to be looked at.
        until = (standing.until if choice.again else None) or due_by
        if choice.instead:
            why = f"{choice.chosen.id} stands for it"
            self._leave_out(choice.instead, why, until, instead=choice.chosen.id)
        if (window := self._in_the_way(choice.chosen)) is not None:
            return self._wait_for_its_end(choice.chosen, window, until, again=choice.again)
        if why := self.ready():
            self._put_off(choice.chosen, why, until)
            return False
        # The robot may have been waited for, and the schedule held meanwhile.
        self.ledger.refresh()
        standing = self.ledger.standing
        late = choose(self.spec, standing, self.clock.now(), due_by).late
        if standing.held or choice.chosen in late or self._in_the_way(choice.chosen) is not None:
            return True
        return self._do(choice.chosen, until, again=choice.again)

    def _in_the_way(self, occasion: Occasion) -> Window | None:
        """The blackout that keeps it from beginning now."""
        return next_free(self.spec, self.clock.now(), self.lasting(occasion.job))[1]

    def _wait_for_its_end(
        self, occasion: Occasion, window: Window, until: datetime, *, again: bool
    ) -> bool:
        """Put it off until it fits, or leave it out where that is too late."""
        now = self.clock.now()
        free, _ = next_free(self.spec, now, self.lasting(occasion.job))
        begins_by = now + self.spec.missed_within if again else occasion.due + lateness(self.spec)
        if free is not None and free <= begins_by:
            self._put_off(occasion, window.why, until)
            return False
        self._leave_out((occasion,), window.why, until)
        return True

    def _put_off(self, occasion: Occasion, why: str, until: datetime) -> None:
        """Note it, once for each reason; everything else due until then is settled."""
        standing = self.ledger.standing
        if (standing.open, standing.why) != (occasion, why):
            self._note("deferred", occasion=occasion.id, why=why, until=time_text(until))

    def _leave_out(self, left: Sequence[Occasion], why: str, until: datetime, **more: str) -> None:
        told = {"since": left[0].id, "occasion": left[-1].id, "count": len(left), "why": why}
        self._announce(self._note("missed", **told, until=time_text(until), **more))

    def _do(self, occasion: Occasion, until: datetime, *, again: bool) -> bool:
        """Work; returns whether something else may be due."""
        more = {"again": True} if again else {}
        self._note("begun", occasion=occasion.id, until=time_text(until), **more)
        self.failure = None
        try:
            with self.guard(self._next_blackout()):
                document = self.work(occasion, self.ledger.folder_of(occasion))
        except Interruption:
            self.ledger.reload()
        except KeyboardInterrupt:
            raise Stopped(
                f"stopped in the middle of {occasion.id}",
                by_signal=True,
                hint="hil schedule run goes on with it",
            ) from None
        except Exception as error:
            return self._ended_badly(occasion, error, until)
        else:
            self._announce(self._note("done", occasion=occasion.id, result=dict(document)))
        return True

    def _ended_badly(self, occasion: Occasion, error: Exception, until: datetime) -> bool:
        if isinstance(error, Stopped) and error.by_signal:
            raise error
        # Not there, or somebody else's, which `ready` came too early to see.
        if isinstance(error, RobotConnectionError) and (why := self.ready()):
            self._put_off(occasion, why, until)
            return False
        known = error if isinstance(error, HilError) else HilError(f"{error!r}")
        self.failure = known
        told = {"kind": type(error).__name__, "why": known.message, "hint": known.hint}
        # In one line: no crash may come between the failure and the hold.
        event = "held" if needs_a_look(error) else "failed"
        self._announce(self._note(event, occasion=occasion.id, **told))
        return True

    def _next_blackout(self) -> datetime | None:
        now = self.clock.now()
        window = window_in(self.spec, now, now + WEEK)
        return window.begin if window else None

    def _note(self, event: str, **more: Any) -> Line:
        line = self.ledger.add(event, self.clock.now(), **more)
        self.tell(line)
        return line

    def _announce(self, line: Line) -> None:
        if problem := self.notify(line):
            about = {"occasion": line["occasion"]} if "occasion" in line else {}
            self._note("unnotified", **about, why=problem)
