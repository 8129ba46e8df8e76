"""The loop of a schedule: what is due is done, once, and written down.

It works on a clock, so that simulations, dry runs and tests have one of their own. Due times are
computed from that clock every time: a computer that slept, or whose clock was set, is no matter.
Before an occasion the robot is asked whether it is free and safe to use; when a blackout begins,
what is under way is stopped as by SIGTERM; a command of the lab's own is told what came of it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from hil.core import HilError, RobotConnectionError, Stopped, json_text, plain
from hil.engine import REST_RAD_S, own_checks
from hil.maintenance.due_times import (
    Window,
    choose,
    late_words,
    lateness,
    next_free,
    occasions,
    window_in,
)
from hil.maintenance.ledger import Job, Ledger, Occasion, Work, ahead, needs_a_look, time_text
from hil.planning import Experiment, held
from hil.robot import Status
from hil.spec import ScheduleSpec
from hil.workflow import check_driver

if TYPE_CHECKING:
    from hil.robot import Robot


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


AWAKE_EVERY = timedelta(seconds=60)
"""Longest sleep: a computer that was suspended, or whose clock was set, finds out after that."""


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


_GRACE_S = 12 * 3600
"""APScheduler would otherwise drop an alarm that is a second late."""


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


@contextlib.contextmanager
def curfew(moment: datetime | None) -> Iterator[None]:
    """Interrupt what is done inside when a moment of the wall clock comes.

    A run stops its robot safely and can be gone on with, as after `kill`. Does nothing outside the
    main thread, where runs do not hear signals.

    Raises:
        Interruption: The moment came.
    """
    if moment is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    over, rung = threading.Event(), threading.Event()
    watch = threading.Thread(
        target=_ring_at, args=(moment, over, rung), name="hil-curfew", daemon=True
    )
    before = signal.getsignal(signal.SIGTERM)
    if before is signal.SIG_DFL:  # it would end the process
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    watch.start()
    try:
        try:
            yield
        finally:
            over.set()
            watch.join()
    except BaseException as error:
        if rung.is_set():
            raise Interruption("a blackout began") from error
        raise
    finally:
        if before is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, before)


_LOOK_EVERY_S = 1.0


def _ring_at(moment: datetime, over: threading.Event, rung: threading.Event) -> None:
    while not over.is_set():
        left_s = (moment - datetime.now(UTC)).total_seconds()
        if left_s <= 0:
            rung.set()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            return
        over.wait(min(left_s, _LOOK_EVERY_S))


@dataclass(frozen=True, slots=True)
class RobotReady:
    """Why a robot cannot be used now, as a text; empty when it can.

    A robot is connected to, leased meanwhile, and asked what the preflight asks of it: whether it
    is at rest, without a fault, and what it finds about itself, such as remote control or
    a protective stop. A robot on a virtual clock is this process's own, and always ready.

    Attributes:
        experiment: Says which robot of which station.
        wait_s: How long a robot that somebody else holds is waited for [s].
        tell: Is told once who is waited for.
    """

    experiment: Experiment
    wait_s: float = 0.0
    tell: Callable[[str], object] = lambda text: None

    def __call__(self) -> str:
        """Ask."""
        try:
            if check_driver(self.experiment).clock == "virtual":
                return ""
            with held(self.experiment, wait_s=self.wait_s, report=self.tell) as (robot, _):
                return _trouble(robot)
        except HilError as error:
            return error.message
        except Exception as error:  # a driver may fail in any way it likes
            return f"the robot cannot be asked: {error!r}"


def _trouble(robot: Robot) -> str:
    """What keeps a connected robot from being moved."""
    state = robot.read()[-1]
    told = []
    if int(state["status"]) & Status.FAULT or int(state["fault_code"]):
        told.append(f"the controller reports fault code {int(state['fault_code'])}")
    if (speed := float(np.abs(state["qd"]).max())) > REST_RAD_S:
        told.append(f"its fastest joint moves at {speed:.4f} rad/s")
    told += [result.message for result in own_checks(robot) if not result.passed]
    return "; ".join(told)


WITHIN_S = 60.0


@dataclass(frozen=True, slots=True)
class Command:
    """Run after every occasion; nothing it does ends the loop.

    Attributes:
        words: The command and its arguments; empty for none.
        schedule: Name of the schedule, in what it is told.
        within_s: It is killed after that time [s].
    """

    words: tuple[str, ...]
    schedule: str
    within_s: float = WITHIN_S

    def __call__(self, line: Mapping[str, Any]) -> str:
        """Tell it a line of the ledger; returns why that failed, or nothing."""
        if not self.words:
            return ""
        told = {key: value for key, value in line.items() if key != "before"}
        text = json_text({"schedule": self.schedule, **told})
        try:
            return self._run(text.encode())
        except subprocess.TimeoutExpired:
            return f"{self.words[0]} did not end within {self.within_s:g} s"
        except (OSError, ValueError) as error:
            return f"{self.words[0]} cannot be run: {error}"

    def _run(self, said: bytes) -> str:
        # Files, not pipes: a grandchild may keep a pipe open for as long as it likes.
        with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as told:
            given.write(said)
            given.seek(0)
            command = subprocess.Popen(  # noqa: S603
                self.words,
                stdin=given,
                stdout=subprocess.DEVNULL,
                stderr=told,
                start_new_session=True,
            )
            try:
                code = command.wait(self.within_s)
            finally:
                if command.poll() is None:
                    os.killpg(command.pid, signal.SIGKILL)
                    command.wait()
            told.seek(0)
            last = told.read().decode("utf-8", "replace").strip().splitlines()[-1:]
        if not code:
            return ""
        return f"{self.words[0]} ended with {code}" + "".join(f": {plain(line)}" for line in last)
