"""Loop of a schedule: each due occasion is done exactly one time and recorded in the ledger.

The clock of the loop can be exchanged: simulations, forecasts and tests use a virtual clock. Due
times are computed from the clock in every cycle of the loop. A suspended computer or a change of
the clock therefore causes no error. Before an occasion begins, the loop checks whether the robot is
free and safe to use (`RobotReady`). When a blackout begins, the running work is stopped as by
SIGTERM (`interrupt_at`). The result of an occasion is passed to a command of the lab (`Command`).
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
"""Interval after which a robot that was not ready, or a held schedule, is checked again."""

LONGEST_WORK = timedelta(days=8)
"""Maximum duration of an occasion; a blackout that begins later does not interrupt the occasion."""

Line = Mapping[str, Any]


class Clock(Protocol):
    """Clock of a scheduler loop."""

    def now(self) -> datetime:
        """Return the current time of the clock, with a time zone."""

    def sleep_until(self, moment: datetime) -> None:
        """Wait until the time `moment`; the method may return earlier."""


class Interruption(Exception):
    """Interruption of work by the beginning of a blackout."""


Guard = Callable[[datetime | None], AbstractContextManager[None]]
"""Function that returns a context manager, which raises `Interruption` inside its block at the
passed time, if a time is passed.
"""


@dataclass
class Scheduler:
    """Loop of a schedule.

    Args:
        spec: Schedule.
        ledger: Ledger of the schedule's state, which must be locked by this process.
        work: Function that does the job of an occasion.
        clock: Clock from which due occasions are determined.
        lasting: Function that returns the maximum duration of a job; a job must fit between two
            blackouts.
        ready: Function that returns the reason why the robot cannot be used now; empty if the robot
            can be used.
        guard: Function whose context manager interrupts the work when a blackout begins.
        tell: Callback that receives every line that the loop adds to the ledger.
        notify: Callback that receives the ledger line with the result of an occasion. The return
            value of `notify` is a problem, or an empty text.

    Attributes:
        failure: Error of the last occasion; None if the last occasion succeeded.
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
        """Do every occasion when it is due, until the time `end` if it is set.

        Raises:
            Stopped: A signal was received; the unfinished occasion is continued at the next start.
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
                "stopped between two occasions",
                by_signal=True,
                hint="continue with: hil schedule run",
            ) from None

    def run_once(self) -> None:
        """Do the occasions that are due at this moment, but not those that become due meanwhile.

        Raises:
            Stopped, DataError, RecordingError, RegistryError: The conditions are the same as for
                `run`.
        """
        due_by = self.clock.now()
        while self._do_next(due_by):
            pass

    def run_due(self, end: datetime | None = None) -> None:
        """Do all occasions that are due and can be done now, until the time `end`.

        If a job takes longer than its interval, an occasion of this job is always due.

        Raises:
            Stopped, DataError, RecordingError, RegistryError: The conditions are the same as for
                `run`.
        """
        while (end is None or self.clock.now() < end) and self._do_next():
            pass

    def next_moment(self) -> datetime | None:
        """Return the next time at which an occasion may be due; None if there is none."""
        standing, now = self.ledger.standing, self.clock.now()
        assert standing.anchor is not None
        assert standing.until is not None
        if standing.held is not None:  # check whether it was released
            return now + LOOK_AGAIN
        # Occasions that become due wait for the open one, so they need no wake-up.
        after = max(now, standing.until) if standing.open else standing.until
        coming = next(occasions(self.spec, standing.anchor, after), None)
        moments = [coming.due] if coming is not None else []
        if standing.open is not None:
            free, window = next_free(self.spec, now, self.lasting(standing.open.job))
            moments.append(free if window and free else now + LOOK_AGAIN)
        return min(moments, default=None)

    def _do_next(self, due_by: datetime | None = None) -> bool:
        """Do the next occasion; return whether further occasions may be due.

        Args:
            due_by: Time limit of due times; occasions due later wait. The value of `due_by` is None
                for the current time.
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
        # A continued occasion was chosen earlier. Occasions that have become due since are not
        # settled by it.
        until = (standing.until if choice.again else None) or due_by
        if choice.instead:
            why = f"{choice.occasion.id} replaces it"
            self._leave_out(choice.instead, why, until, instead=choice.occasion.id)
        if (window := self._blackout_for(choice.occasion)) is not None:
            return self._wait_for_end_of(window, choice.occasion, until, again=choice.again)
        if why := self.ready():
            self._put_off(choice.occasion, why, until)
            return False
        # The wait for the robot may have been long: check again for a hold and a blackout.
        self.ledger.refresh()
        standing = self.ledger.standing
        late = choose(self.spec, standing, self.clock.now(), due_by).late
        if standing.held or choice.occasion in late or self._blackout_for(choice.occasion):
            return True
        return self._do(choice.occasion, until, again=choice.again)

    def _blackout_for(self, occasion: Occasion) -> Window | None:
        """Return the blackout that prevents an occasion from beginning now, or else None."""
        return next_free(self.spec, self.clock.now(), self.lasting(occasion.job))[1]

    def _wait_for_end_of(
        self, window: Window, occasion: Occasion, until: datetime, *, again: bool
    ) -> bool:
        """Defer an occasion until it fits between blackouts, or omit it if that is too late."""
        now = self.clock.now()
        free, _ = next_free(self.spec, now, self.lasting(occasion.job))
        begins_by = now + self.spec.missed_within if again else occasion.due + lateness(self.spec)
        if free is not None and free <= begins_by:
            self._put_off(occasion, window.why, until)
            return False
        self._leave_out((occasion,), window.why, until)
        return True

    def _put_off(self, occasion: Occasion, why: str, until: datetime) -> None:
        """Record in the ledger that an occasion is deferred, one line per reason."""
        standing = self.ledger.standing
        if (standing.open, standing.why) != (occasion, why):
            self._note("deferred", occasion=occasion.id, why=why, until=time_text(until))

    def _leave_out(self, left: Sequence[Occasion], why: str, until: datetime, **more: str) -> None:
        which = {"since": left[0].id, "occasion": left[-1].id, "count": len(left)}
        self._announce(self._note("missed", **which, why=why, until=time_text(until), **more))

    def _do(self, occasion: Occasion, until: datetime, *, again: bool) -> bool:
        """Do the job of an occasion; return whether a further occasion may be due."""
        more = {"again": True} if again else {}
        self._note("begun", occasion=occasion.id, until=time_text(until), **more)
        self.failure = None
        try:
            now = self.clock.now()
            window = window_in(self.spec, now, now + LONGEST_WORK)
            with self.guard(window.begin if window else None):
                document = self.work(occasion, self.ledger.folder_of(occasion))
        except Interruption:
            self.ledger.reload()  # the occasion stays open and continues after the blackout
        except KeyboardInterrupt:
            raise Stopped(
                f"stopped during {occasion.id}",
                by_signal=True,
                hint="resume it with: hil schedule run",
            ) from None
        except Exception as error:
            return self._ended_badly(occasion, error, until)
        else:
            self._announce(self._note("done", occasion=occasion.id, result=dict(document)))
        return True

    def _ended_badly(self, occasion: Occasion, error: Exception, until: datetime) -> bool:
        if isinstance(error, Stopped) and error.by_signal:
            raise error
        # The robot was disconnected, or leased by a different process, after `ready` was called.
        if isinstance(error, RobotConnectionError) and (why := self.ready()):
            self._put_off(occasion, why, until)
            return False
        self.failure = error if isinstance(error, HilError) else HilError(f"{error!r}")
        # Failure and hold are one line, so that no crash can separate them.
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
    """Clock that advances when its user sleeps.

    Args:
        moment: Initial time of the clock, with a time zone.
    """

    def __init__(self, moment: datetime) -> None:
        self._moment = moment.astimezone(UTC)

    def now(self) -> datetime:
        """Return the time of the virtual clock, UTC."""
        return self._moment

    def sleep_until(self, moment: datetime) -> None:
        """Advance the virtual clock to `moment`, unless that time has passed."""
        self._moment = max(self._moment, moment.astimezone(UTC))

    def advance(self, by: timedelta) -> None:
        """Advance the virtual clock by a duration."""
        self._moment += by


AWAKE_EVERY = timedelta(seconds=60)
"""Longest sleep. The time is checked again after each sleep, in case the computer was suspended or
its clock was changed.
"""

_GRACE_S = 12 * 3600
"""Time by which an alarm may be late without being dropped [s]; by default, APScheduler would drop
an alarm that is a second late.
"""


class WallClock:
    """Clock of the computer, used as a context manager; APScheduler wakes the sleeping thread.

    The work of an occasion is done on the main thread, because only the main thread receives
    signals.
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
        """Return the current time of the computer, UTC."""
        return datetime.now(UTC)

    def sleep_until(self, moment: datetime) -> None:
        """Sleep until the time `moment`, but at most for a minute."""
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
    """Interrupt the work in a `with` block at a time of the wall clock, as by SIGTERM.

    An interrupted run stops its robot safely and can be resumed, as after `kill`. Outside the main
    thread, runs receive no signals, and the block is not interrupted.

    Raises:
        Interruption: The time of the interruption was reached.
    """
    if moment is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    over, sent = threading.Event(), threading.Event()
    watch = threading.Thread(
        target=_signal_at, args=(moment, over, sent), name="hil-blackout", daemon=True
    )
    before = signal.getsignal(signal.SIGTERM)
    if before is signal.SIG_DFL:  # the default handler would end the process
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
    """Check whether a robot can be used now.

    The robot is leased, connected and checked as in the preflight: it must be static and without a
    fault, and its driver checks, such as remote control or no protective stop, must pass. A robot
    on a virtual clock belongs to this process and is always ready.

    Attributes:
        experiment: Experiment that names the robot and its station.
        wait_s: Maximum time to wait for a robot that a different process has leased [s].
        tell: Callback that is called one time with the process that has leased the robot.
    """

    experiment: Experiment
    wait_s: float = 0.0
    tell: Callable[[str], object] = lambda text: None

    def __call__(self) -> str:
        """Return the reason why the robot cannot be used now; empty if it can be used."""
        try:
            if check_driver(self.experiment).clock == "virtual":
                return ""
            with held(self.experiment, wait_s=self.wait_s, report=self.tell) as (robot, _):
                return _trouble(robot)
        except HilError as error:
            return error.message
        except Exception as error:  # drivers are plug-ins and may raise anything
            return f"the robot's state cannot be read: {error!r}"


def _trouble(robot: Robot) -> str:
    """Return the reasons why a connected robot must not be moved; empty if there is no reason."""
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
    """Command of the lab that runs after every occasion; its failure does not end the loop.

    Attributes:
        words: Command and its arguments; empty if no command is to run.
        schedule: Name of the schedule, which is part of the input to the command.
        within_s: Time limit after which the command is killed [s].
    """

    words: tuple[str, ...]
    schedule: str
    within_s: float = WITHIN_S

    def __call__(self, line: Mapping[str, Any]) -> str:
        """Run the command with a ledger line as its input; return a problem, or an empty text."""
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
        # Files instead of pipes: a grandchild process may keep a pipe open forever.
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
        return f"{self.words[0]} ended with exit code {code}" + "".join(
            f": {plain(text)}" for text in last
        )
