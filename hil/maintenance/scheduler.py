"""The loop of a schedule: what is due is done once, and written into the ledger.

The loop works on a clock, so that simulations, forecasts and tests have one of their own. Due times
are computed from that clock every time, so that a suspended computer, or a clock that was set, does
no harm. Before an occasion the robot is asked whether it is free and safe to use (`RobotReady`).
When a blackout begins, work is stopped as by SIGTERM (`interrupt_at`). The result is passed to a
command of the lab's own (`Command`).
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
from hil.maintenance.ledger import (
    Job,
    Ledger,
    Occasion,
    Work,
    clock_problem,
    needs_inspection,
    time_text,
)
from hil.planning import Experiment, held
from hil.robot import Status
from hil.spec import ScheduleSpec
from hil.workflow import check_driver

if TYPE_CHECKING:
    from hil.robot import Robot


LOOK_AGAIN = timedelta(seconds=60)
"""Interval at which a robot that was not ready, or a held schedule, is looked at again."""

LONGEST_WORK = timedelta(days=8)
"""No occasion takes longer, so that a later blackout interrupts none."""

Line = Mapping[str, Any]


class Clock(Protocol):
    """The clock of a loop."""

    def now(self) -> datetime:
        """Return the present moment, with its time zone."""

    def sleep_until(self, moment: datetime) -> None:
        """Wait until then; may return early."""


class Interruption(Exception):
    """Work was interrupted because a blackout began."""


Guard = Callable[[datetime | None], AbstractContextManager[None]]
"""Interrupts what is done inside at a moment, if there is one, by raising `Interruption`."""


@dataclass
class Scheduler:
    """The loop of a schedule.

    Args:
        spec: The schedule.
        ledger: Of its state, which no other process runs.
        work: Does the job of an occasion.
        clock: The time by which occasions are due.
        lasting: Returns how long a job takes at most; it must fit between blackouts.
        ready: Returns why the robot cannot be used now; empty if it can.
        guard: Interrupts work when a blackout begins.
        tell: Called with every line that the loop adds to the ledger.
        notify: Called with the result of an occasion; returns why it could not be passed on, or
            nothing.

    Attributes:
        failure: Error of the last occasion; None if it succeeded.
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
        """Do what is due whenever it is, until `end` if there is one.

        Raises:
            Stopped: A signal came; an occasion that was begun is continued at the next start.
            DataError, RecordingError, RegistryError: The ledger is damaged or cannot be written.
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
        while self._do_next(due_by):
            pass

    def run_due(self, end: datetime | None = None) -> None:
        """Do everything that is due, as far as it can be done now, and before `end`.

        A job that takes longer than its interval is always due again.

        Raises:
            Stopped, DataError, RecordingError, RegistryError: See `run`.
        """
        while (end is None or self.clock.now() < end) and self._do_next():
            pass

    def next_moment(self) -> datetime | None:
        """Return when something may have to be done again; None if never."""
        standing, now = self.ledger.standing, self.clock.now()
        assert standing.anchor is not None
        assert standing.until is not None
        if standing.held is not None:  # it may have been released by then
            return now + LOOK_AGAIN
        # Occasions that come due beside an open one wait for it: they are no reason to wake.
        after = max(now, standing.until) if standing.open else standing.until
        coming = next(occasions(self.spec, standing.anchor, after), None)
        moments = [coming.due] if coming is not None else []
        if standing.open is not None:
            free, window = next_free(self.spec, now, self.lasting(standing.open.job))
            moments.append(free if window and free else now + LOOK_AGAIN)
        return min(moments, default=None)

    def _do_next(self, due_by: datetime | None = None) -> bool:
        """Do what is to be done first; return whether there may be more to do.

        Args:
            due_by: Occasions that are due later wait; by default the present moment.
        """
        self.ledger.refresh()
        now, standing = self.clock.now(), self.ledger.standing
        due_by = min(due_by or now, now)
        if standing.held is None and (why := clock_problem(standing, now)):
            self._announce(self._note("held", why=why))
        if self.ledger.standing.held is not None:
            return False
        choice = choose(self.spec, standing, now, due_by)
        if choice.late:
            why = late_words(self.spec, standing, choice.late)
            self._leave_out(choice.late, why, choice.late[-1].due)
        if choice.occasion is None:
            return bool(choice.late)
        # An occasion that was begun was chosen before: others may have come due since, and are not
        # settled by it.
        until = (standing.until if choice.again else None) or due_by
        if choice.instead:
            why = f"{choice.occasion.id} stands for it"
            self._leave_out(choice.instead, why, until, instead=choice.occasion.id)
        if (window := self._blackout_for(choice.occasion)) is not None:
            return self._wait_for_end_of(window, choice.occasion, until, again=choice.again)
        if why := self.ready():
            self._put_off(choice.occasion, why, until)
            return False
        # Waiting for the robot may have taken long, and the schedule may be held by now.
        self.ledger.refresh()
        standing = self.ledger.standing
        late = choose(self.spec, standing, self.clock.now(), due_by).late
        if standing.held or choice.occasion in late or self._blackout_for(choice.occasion):
            return True
        return self._do(choice.occasion, until, again=choice.again)

    def _blackout_for(self, occasion: Occasion) -> Window | None:
        """Return the blackout that keeps an occasion from beginning now."""
        return next_free(self.spec, self.clock.now(), self.lasting(occasion.job))[1]

    def _wait_for_end_of(
        self, window: Window, occasion: Occasion, until: datetime, *, again: bool
    ) -> bool:
        """Put an occasion off until it fits, or leave it out if that is too late."""
        now = self.clock.now()
        free, _ = next_free(self.spec, now, self.lasting(occasion.job))
        begins_by = now + self.spec.missed_within if again else occasion.due + lateness(self.spec)
        if free is not None and free <= begins_by:
            self._put_off(occasion, window.why, until)
            return False
        self._leave_out((occasion,), window.why, until)
        return True

    def _put_off(self, occasion: Occasion, why: str, until: datetime) -> None:
        """Note that an occasion is put off, once for each reason."""
        standing = self.ledger.standing
        if (standing.open, standing.why) != (occasion, why):
            self._note("deferred", occasion=occasion.id, why=why, until=time_text(until))

    def _leave_out(self, left: Sequence[Occasion], why: str, until: datetime, **more: str) -> None:
        which = {"since": left[0].id, "occasion": left[-1].id, "count": len(left)}
        self._announce(self._note("missed", **which, why=why, until=time_text(until), **more))

    def _do(self, occasion: Occasion, until: datetime, *, again: bool) -> bool:
        """Do the job of an occasion; return whether something else may be due."""
        more = {"again": True} if again else {}
        self._note("begun", occasion=occasion.id, until=time_text(until), **more)
        self.failure = None
        try:
            now = self.clock.now()
            window = window_in(self.spec, now, now + LONGEST_WORK)
            with self.guard(window.begin if window else None):
                document = self.work(occasion, self.ledger.folder_of(occasion))
        except Interruption:
            self.ledger.reload()  # it stays open, and is continued after the blackout
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
        # The robot is gone, or another process took it after `ready` was asked.
        if isinstance(error, RobotConnectionError) and (why := self.ready()):
            self._put_off(occasion, why, until)
            return False
        self.failure = error if isinstance(error, HilError) else HilError(f"{error!r}")
        # Failure and hold are one line: no crash may come between them.
        self._announce(
            self._note(
                "held" if needs_inspection(error) else "failed",
                occasion=occasion.id,
                kind=type(error).__name__,
                why=self.failure.message,
                hint=self.failure.hint,
            )
        )
        return True

    def _note(self, event: str, **more: Any) -> Line:
        line = self.ledger.add(event, self.clock.now(), **more)
        self.tell(line)
        return line

    def _announce(self, line: Line) -> None:
        if problem := self.notify(line):
            about = {"occasion": line["occasion"]} if "occasion" in line else {}
            self._note("unnotified", **about, why=problem)


class VirtualClock:
    """A clock that sleeping puts forward.

    Args:
        moment: Where it starts, with its time zone.
    """

    def __init__(self, moment: datetime) -> None:
        self._moment = moment.astimezone(UTC)

    def now(self) -> datetime:
        """Return the moment it shows, UTC."""
        return self._moment

    def sleep_until(self, moment: datetime) -> None:
        """Put it forward to that moment, unless it is past."""
        self._moment = max(self._moment, moment.astimezone(UTC))

    def advance(self, by: timedelta) -> None:
        """Put it forward."""
        self._moment += by


AWAKE_EVERY = timedelta(seconds=60)
"""Longest sleep: after it, the time is looked at again, in case the computer was suspended or its
clock set."""

_GRACE_S = 12 * 3600
"""APScheduler would otherwise drop an alarm that is a second late."""


class WallClock:
    """The computer's clock, with APScheduler to wake the thread that sleeps; a context manager.

    Work is done on the main thread: only it receives signals.
    """

    def __init__(self) -> None:
        from apscheduler.schedulers.background import BackgroundScheduler

        logging.getLogger("apscheduler").setLevel(logging.ERROR)
        defaults = {"coalesce": True, "max_instances": 1, "misfire_grace_time": _GRACE_S}
        self._scheduler: Any = BackgroundScheduler(job_defaults=defaults, timezone=UTC)
        self._awake = threading.Event()

    def __enter__(self) -> WallClock:
        from apscheduler.events import EVENT_JOB_ERROR, EVENT_JOB_MISSED

        self._scheduler.add_listener(self._wake, EVENT_JOB_ERROR | EVENT_JOB_MISSED)
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
        """Return the present moment, UTC."""
        return datetime.now(UTC)

    def sleep_until(self, moment: datetime) -> None:
        """Sleep until then, a minute at most."""
        now = self.now()
        if moment <= now:
            return
        self._awake.clear()
        wakes = min(moment, now + AWAKE_EVERY)
        self._scheduler.add_job(
            self._wake, "date", run_date=wakes, id="next", replace_existing=True
        )
        self._awake.wait(AWAKE_EVERY.total_seconds())

    def _wake(self, event: object = None) -> None:
        self._awake.set()


@contextlib.contextmanager
def interrupt_at(moment: datetime | None) -> Iterator[None]:
    """Interrupt what is done inside at a moment of the wall clock, as by SIGTERM.

    A run then stops its robot safely and can be resumed, as after `kill`. Does nothing outside the
    main thread, where runs do not get signals.

    Raises:
        Interruption: The moment came.
    """
    if moment is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    over, sent = threading.Event(), threading.Event()
    watch = threading.Thread(
        target=_signal_at, args=(moment, over, sent), name="hil-blackout", daemon=True
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
        if sent.is_set():
            raise Interruption("a blackout began") from error
        raise
    finally:
        if before is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, before)


_LOOK_EVERY_S = 1.0


def _signal_at(moment: datetime, over: threading.Event, sent: threading.Event) -> None:
    while not over.is_set():
        left_s = (moment - datetime.now(UTC)).total_seconds()
        if left_s <= 0:
            sent.set()
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            return
        over.wait(min(left_s, _LOOK_EVERY_S))


@dataclass(frozen=True, slots=True)
class RobotReady:
    """Whether a robot can be used now.

    The robot is leased, connected to, and checked as in the preflight: whether it is at rest and
    without a fault, and its own checks, such as remote control or a protective stop. A robot on
    a virtual clock belongs to this process, and is always ready.

    Attributes:
        experiment: Says which robot of which station.
        wait_s: How long to wait for a robot that another process holds [s].
        tell: Called once with the holder that is waited for.
    """

    experiment: Experiment
    wait_s: float = 0.0
    tell: Callable[[str], object] = lambda text: None

    def __call__(self) -> str:
        """Return why the robot cannot be used now; empty if it can."""
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
    """Return what keeps a connected robot from being moved; empty if nothing does."""
    state = robot.read()[-1]
    problems = []
    if int(state["status"]) & Status.FAULT or int(state["fault_code"]):
        problems.append(f"the controller reports fault code {int(state['fault_code'])}")
    if (speed := float(np.abs(state["qd"]).max())) > REST_RAD_S:
        problems.append(f"its fastest joint moves at {speed:.4f} rad/s")
    problems += [result.message for result in own_checks(robot) if not result.passed]
    return "; ".join(problems)


WITHIN_S = 60.0


@dataclass(frozen=True, slots=True)
class Command:
    """A command of the lab that is run after every occasion; its failure does not end the loop.

    Attributes:
        words: The command and its arguments; empty for none.
        schedule: Name of the schedule, which its input has.
        within_s: It is killed after that time [s].
    """

    words: tuple[str, ...]
    schedule: str
    within_s: float = WITHIN_S

    def __call__(self, line: Mapping[str, Any]) -> str:
        """Run it with a line of the ledger as its input; return why that failed, or nothing."""
        if not self.words:
            return ""
        content = {key: value for key, value in line.items() if key != "before"}
        try:
            return self._run(json_text({"schedule": self.schedule, **content}).encode())
        except subprocess.TimeoutExpired:
            return f"{self.words[0]} did not end within {self.within_s:g} s"
        except (OSError, ValueError) as error:
            return f"{self.words[0]} cannot be run: {error}"

    def _run(self, line: bytes) -> str:
        # Files, not pipes: a grandchild may keep a pipe open for as long as it likes.
        with tempfile.TemporaryFile() as stdin, tempfile.TemporaryFile() as stderr:
            stdin.write(line)
            stdin.seek(0)
            command = subprocess.Popen(  # noqa: S603
                self.words,
                stdin=stdin,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
            )
            try:
                code = command.wait(self.within_s)
            finally:
                if command.poll() is None:
                    os.killpg(command.pid, signal.SIGKILL)
                    command.wait()
            stderr.seek(0)
            last = stderr.read().decode("utf-8", "replace").strip().splitlines()[-1:]
        if not code:
            return ""
        return f"{self.words[0]} ended with {code}" + "".join(f": {plain(text)}" for text in last)
