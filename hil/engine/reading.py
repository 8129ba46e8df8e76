"""Reading the robot: every block is recorded first and judged second.

`Reading.block` is how the control thread sees the robot while a run goes on. What it returns has
been recorded, is fresh (`Freshness`), carries no fault and violates no interlock (`Judge`);
anything else is raised from there, and the engine ends the run. An interlock that stops has
stopped the robot already when its trip is raised.

On the way out the engine calls `Reading.to_rest` instead: it records and watches, and judges only
whether the arm still moves, for nothing may keep it from seeing a stopped arm come to rest.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np

from hil.core import (
    HilError,
    InterlockTripped,
    RecordingError,
    RobotFault,
    StaleState,
    StructArray,
    bounded,
    origin_of,
)
from hil.engine.interlocks import STALE_AFTER_S, Interlock, Trip, is_slowed
from hil.robot import HasSpeedScaling, HasTopics, Robot, Status

AT_REST_RAD_S = 0.01
"""All joints slower than this, and no motion commanded, is at rest."""

STOP_WITHIN_S = 2.0
"""A driver whose `stop` takes longer hangs; the contract allows 0.1 s."""

REST_WITHIN_S = 5.0
"""An arm that still moves this long after it was stopped is reported as not at rest [s]."""

NEWS_SHARE = 0.05
"""A speed scaling that has changed by so much more is another event of the log."""


def stop_robot(robot: Robot) -> None:
    """Stop a robot; safe from any thread.

    Raises:
        HilError: The driver says why it cannot, or its `stop` does not return (`RobotTimeout`).
    """
    bounded(robot.stop, STOP_WITHIN_S, "stopping the robot")


class Sink(Protocol):
    """Where samples and events go: the recorder, or a list in tests."""

    def put(self, rows: StructArray) -> None:
        """Take over a block of the base record; raises `RecordingError` when it cannot be kept."""

    def put_topic(self, topic: str, rows: StructArray) -> None:
        """Take over rows of one of the robot's further topics (`hil.robot.HasTopics`)."""

    def event(self, kind: str, **details: Any) -> None:
        """Take over one event."""


@dataclass(slots=True)
class Progress:
    """What has been read and done.

    Attributes:
        samples: Rows of the base record.
        first, last: Device time of the first and the newest row [s].
        unsettled: Steps whose dwell ran into its time-out.
        steps_done: Plan steps executed to their end.
    """

    samples: int = 0
    first: float = float("nan")
    last: float = float("nan")
    unsettled: list[int] = field(default_factory=list)
    steps_done: int = 0

    def count(self, block: StructArray) -> None:
        """Add a block."""
        if self.samples == 0:
            self.first = float(block["device_time"][0])
        self.samples += len(block)
        self.last = float(block["device_time"][-1])


class Reading:
    """Reads one robot for one run.

    Args:
        robot: Connected.
        sink: Receives everything.
        interlocks: Judged on every sample.
        joint_names: For messages.
        obey_stop: Called before every block; raises if a stop was requested.
        hold: Called with every trip of an interlock that only pauses the run.
        on_block: Called with every block after it was recorded and judged.
        stale_after_s: How long the state may stand still [s]; None for the default.

    Attributes:
        judge: Asks the interlocks.
        wall: Whether the robot lives in wall time.
        progress: What has been read and done so far.
        newest: The newest row of the run; None before the first.
    """

    def __init__(
        self,
        robot: Robot,
        sink: Sink,
        interlocks: Sequence[Interlock],
        joint_names: Sequence[str],
        *,
        obey_stop: Callable[[], object],
        hold: Callable[[Trip], object],
        on_block: Callable[[StructArray], object],
        stale_after_s: float | None = None,
    ) -> None:
        self._robot = robot
        self._topics = robot if isinstance(robot, HasTopics) else None
        self._scaled = robot if isinstance(robot, HasSpeedScaling) else None
        self._scaling = self._lowest = 1.0
        self._slowed_at: list[float] = []
        self._leg_slowed = False
        self._sink = sink
        self._joint_names = tuple(joint_names)
        self._obey_stop = obey_stop
        self._hold = hold
        self._on_block = on_block
        self.judge = Judge(interlocks)
        self.wall = robot.capabilities.clock == "wall"
        self._freshness = Freshness(stale_after_s, wall=self.wall)
        self.progress = Progress()
        self.newest: np.void | None = None

    def block(self) -> StructArray:
        """Return the next block, recorded and judged.

        Raises:
            Stopped: A stop was requested.
            RobotError: The robot reports a fault.
            InterlockTripped: A sample violates an interlock, or none is new for too long.
            RecordingError: The sink cannot keep the data.
        """
        self._obey_stop()
        if self._topics is not None and not self.progress.samples:
            self._topics.drain()  # belongs to what was read before the run
        block = self._robot.read()
        self._mark_speed(block)
        self._keep(block)
        self.progress.count(block)
        self.newest = block[-1]
        self._freshness.check(block)
        if (block["status"] & Status.FAULT).any():
            raise self._fault(block)
        for interlock, trip in self.judge.violations(block):
            if interlock.action == "pause":
                self._hold(trip)
                continue
            # At once; the engine stops it again on the way out and says if that does not work.
            with contextlib.suppress(Exception):
                stop_robot(self._robot)
            raise trip.error(self._joint_names)
        self._on_block(block)
        return block

    def to_rest(self) -> str:
        """Record a stopped robot until it is at rest; return what is wrong, or nothing."""
        deadline = self.deadline(REST_WITHIN_S)
        try:
            while True:
                block = self._robot.read()
                # A recorder that is dead or behind does not keep us from watching the arm.
                with contextlib.suppress(RecordingError):
                    self._mark_speed(block)
                    self._keep(block)
                self.progress.count(block)
                last = block[-1]
                slow = bool((np.abs(last["qd"]) < AT_REST_RAD_S).all())
                if slow and not last["status"] & Status.MOVING:
                    return ""
                self._freshness.check(block)
                if deadline.over(self.progress.last):
                    return f"the arm was not at rest {REST_WITHIN_S:g} s after it was stopped"
        except HilError as error:
            return f"nobody saw the arm come to rest: {error.message}"

    def deadline(self, seconds: float) -> Deadline:
        """Return a time-out that begins now."""
        return Deadline(seconds, self.progress.last, wall=self.wall)

    def begin_leg(self) -> None:
        """Begin a leg: it counts as slowed from its start if the speed is lowered now."""
        self._leg_slowed = is_slowed(self._scaling)

    @property
    def speed_share(self) -> float:
        """Share of the planned speed at which the robot's controller moves now, 0 to 1."""
        return self._scaling if is_slowed(self._scaling) else 1.0

    @property
    def slowed(self) -> str:
        """The speed to which the robot's controller scales motions now; empty if as planned."""
        if not is_slowed(self._scaling):
            return ""
        return f"the robot's speed scaling (speed slider) is at {self._scaling:.0%}"

    @property
    def notes(self) -> list[str]:
        """Notes on the data for the operator, beside the cause of the end."""
        if not self._slowed_at:
            return []
        times = f"{len(self._slowed_at)} times, first" if len(self._slowed_at) > 1 else "once,"
        return [
            f"the robot's speed scaling (speed slider) was lowered {times} at device time "
            f"{self._slowed_at[0]:.3f} s; lowest value {self._lowest:.0%}. Measurements at reduced "
            "speed are excluded"
        ]

    def _mark_speed(self, block: StructArray) -> None:
        """Mark all of a measurement during which the controller moved slower than planned."""
        if self._scaled is None:
            return
        before, now = self._scaling, self._scaled.speed_scaling
        was, slowed = is_slowed(before), is_slowed(now)
        if was != slowed or (slowed and abs(now - before) >= NEWS_SHARE):
            self._scaling = now
            first, last = block[0], block[-1]
            if slowed and not was:
                self._slowed_at.append(float(first["device_time"]))
            self._sink.event(
                "speed_scaling",
                share=round(now, 4),
                segment=int(last["segment"]),
                device_time=float(last["device_time"]),
            )
        if slowed:
            self._lowest = min(self._lowest, now)
        self._leg_slowed = self._leg_slowed or slowed
        if self._leg_slowed:
            block["status"] |= int(Status.SLOWED)

    def _keep(self, block: StructArray) -> None:
        self._sink.put(block)
        if self._topics is not None:
            for topic, rows in self._topics.drain().items():
                self._sink.put_topic(topic, rows)

    def _fault(self, block: StructArray) -> HilError:
        """Return the driver's own words if the next read brings them, else the code."""
        try:
            self._robot.read()
        except HilError as error:
            return error
        row = block[(block["status"] & Status.FAULT) != 0][0]
        return RobotFault(
            f"the controller reports fault {int(row['fault_code'])} "
            f"at device time {float(row['device_time']):.3f} s",
            hint="look the code up in the controller's manual and clear the cause",
        )


SLOW_S = 0.25
"""An interlock that takes longer for a block keeps the robot waiting [s]."""

_T = TypeVar("_T")


class Judge:
    """Asks every interlock about a block; one that raises, hangs or dawdles is called by its name.

    Args:
        interlocks: In the order in which they are asked.
        now: Monotonic clock [s].
    """

    def __init__(
        self, interlocks: Sequence[Interlock], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._interlocks = tuple(interlocks)
        self._now = now
        self._asking: Interlock | None = None
        # The first block is judged before anything moves: there an interlock may take its time.
        self._armed = False
        self._slow: dict[str, float] = {}

    def violations(self, block: StructArray) -> Iterator[tuple[Interlock, Trip]]:
        """Yield the interlocks that a block violates, each as soon as it has answered.

        Raises:
            InterlockTripped: An interlock raises, or returns no trip: it cannot judge.
        """
        for interlock in self._interlocks:
            trip = self._asked(interlock, interlock.check, block)
            if trip is not None and not isinstance(trip, Trip):
                raise _cannot(interlock, f"check returned {trip!r}, which is no Trip")
            if trip is not None:
                yield interlock, trip
        self._armed = True

    def clear(self, block: StructArray) -> bool:
        """Return whether no interlock that pauses is anywhere near its limit in a block."""
        pausing = (i for i in self._interlocks if i.action == "pause")
        return all(self._asked(interlock, interlock.clear, block) for interlock in pausing)

    @property
    def hanging(self) -> InterlockTripped | None:
        """The interlock that is being asked at this moment, as the error of one that hangs."""
        asking = self._asking
        return _cannot(asking, "it did not return for seconds") if asking else None

    @property
    def notes(self) -> list[str]:
        """Interlocks that kept the robot waiting, in words."""
        return [
            f"interlock {name} took up to {seconds:.2g} s for one block: it must not wait"
            for name, seconds in self._slow.items()
        ]

    def _asked(
        self, interlock: Interlock, ask: Callable[[StructArray], _T], block: StructArray
    ) -> _T:
        self._asking, begin = interlock, self._now()
        try:
            return ask(block)
        except HilError:
            raise
        except Exception as error:  # a plug-in may raise anything
            raise _cannot(interlock, f"{type(error).__name__}: {error}", error) from error
        finally:
            self._asking, took = None, self._now() - begin
            if took > SLOW_S and self._armed:
                self._slow[interlock.name] = max(took, self._slow.get(interlock.name, 0.0))


def _cannot(interlock: Interlock, why: str, error: Exception | None = None) -> InterlockTripped:
    """Return the trip of an interlock that cannot judge: what cannot be judged is not safe."""
    where = ""
    if error is not None:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        place = f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}" if trace else "its check"
        where = f", raised in {place}"
    return InterlockTripped(
        f"interlock {interlock.name}: {why}",
        hint=f"mend the interlock ({origin_of(interlock)}{where}), or leave it out of the spec",
    )


STALE_AFTER_BLOCKS = 50
"""Blocks in a row without a newer sample; a virtual clock has no other measure."""


class Freshness:
    """Follows the device clock and trips when it brings nothing newer: the interlock `stale`.

    Args:
        after_s: Wall time without a newer sample that counts as stale [s]; None for the default.
        wall: Whether the robot lives in wall time; on a virtual clock blocks are counted.
        now: Monotonic clock [s].
    """

    def __init__(
        self,
        after_s: float | None = None,
        *,
        wall: bool = True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._after_s = STALE_AFTER_S if after_s is None else after_s
        self._wall = wall
        self._now = now
        self._newest = -np.inf
        self._since = now()
        self._blocks = 0

    def check(self, block: StructArray) -> None:
        """Judge one block.

        Raises:
            StaleState: Its time is not a number.
            InterlockTripped: Its time has not advanced for too long.
        """
        times = block["device_time"]
        if not np.isfinite(times).all():
            raise StaleState(
                "the robot's clock is not a number",
                hint="check the driver: every row needs a finite device_time",
            )
        if times[-1] > self._newest:
            self._newest, self._since, self._blocks = float(times[-1]), self._now(), 0
            return
        self._blocks += 1
        if silence := self._too_long():
            raise InterlockTripped(
                f"interlock stale: the robot's clock {self._how(float(times[-1]))}: {silence}",
                hint="check the connection and the controller; the data so far is kept",
            )

    def _too_long(self) -> str:
        """Return how long nothing new came, in words; nothing while that is within bounds."""
        if not self._wall:
            blocks = f"{self._blocks} blocks in a row brought nothing new"
            return blocks if self._blocks > STALE_AFTER_BLOCKS else ""
        quiet = self._now() - self._since
        limit = f"limit {self._after_s:g} s"
        return f"nothing new for {quiet:.3g} s, {limit}" if quiet > self._after_s else ""

    def _how(self, time_s: float) -> str:
        if time_s < self._newest:
            return f"went backwards, from {self._newest:.3f} s to {time_s:.3f} s"
        return f"stands still at {self._newest:.3f} s"


STANDS_STILL_S = 0.5
"""Wall time after which a device clock that has not gone on is taken to stand still [s]."""

LEAST_WALL_S = 1.0
"""A computer is allowed this much even where a simulated second lasts a tenth of one [s]."""


class Deadline:
    """A time-out by the device clock, or by the wall clock where the device clock stands still.

    In wall time the device clock alone is not enough before `LEAST_WALL_S`: a mock in a hurry must
    not make a time-out of every moment in which this process does not get the processor. The wall
    clock alone is not enough while device time goes on: simulated drives on a busy computer are
    slower than they are planned to be, and nothing is wrong with them.

    Args:
        seconds: Time allowed.
        begin: Device time now [s].
        wall: Whether the robot lives in wall time; on a virtual clock only device time counts.
        now: Monotonic clock [s].
    """

    def __init__(
        self,
        seconds: float,
        begin: float,
        *,
        wall: bool,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.seconds = seconds
        self._device_end = begin + seconds
        self._now = now
        began = now() if wall else -np.inf
        self._wall_end = began + seconds if wall else np.inf
        self._not_before = began + min(seconds, LEAST_WALL_S)
        self._newest, self._advanced = begin, began

    def extend(self, seconds: float) -> None:
        """Allow more time [s]."""
        self.seconds += seconds
        self._device_end += seconds
        self._wall_end += seconds

    def over(self, device_time: float) -> bool:
        """Return whether the time is up; a device time that is no number counts as up."""
        now = self._now()
        if device_time > self._newest:
            self._newest, self._advanced = device_time, now
        if not device_time <= self._device_end:
            return now >= self._not_before
        return now > self._wall_end and now - self._advanced > STANDS_STILL_S
