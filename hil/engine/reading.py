"""Reading of the robot state: every block of rows is recorded first and checked second.

The control thread calls `Reading.block` to read the robot during a run. A block returned by
`Reading.block` has been recorded, is fresh (`Freshness`), contains no fault and violates no
interlock with the action `stop` (`Judge`). If a block does not meet these conditions,
`Reading.block` raises an error, and the engine ends the run. If an interlock with the action `stop`
trips, the robot is stopped before the error is raised.

While the run ends, the engine calls `Reading.to_rest` instead of `Reading.block`. `Reading.to_rest`
records the state and checks only whether the arm still moves, so that no interlock can interrupt
the monitoring of the stopping arm.
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
"""Joint speed below which an arm without a commanded motion counts as static [rad/s]."""

STOP_WITHIN_S = 2.0
"""Time limit of the method `stop` of a driver [s], after which the driver counts as hanging.

The contract allows 0.1 s.
"""

REST_WITHIN_S = 5.0
"""Time after a stop command at which an arm that still moves is reported as not static [s]."""

NEWS_SHARE = 0.05
"""Minimum change of the speed scaling that is logged as a new event."""


def stop_robot(robot: Robot) -> None:
    """Stop a robot; can be called from any thread.

    Raises:
        HilError: The driver reports an error, or the method `stop` of the driver does not return
            (`RobotTimeout`).
    """
    bounded(robot.stop, STOP_WITHIN_S, "stopping the robot")


class Sink(Protocol):
    """Receiver of samples and events: a recorder, or a list in tests."""

    def put(self, rows: StructArray) -> None:
        """Store a block of rows of the base record.

        Raises `RecordingError` if the block cannot be stored.
        """

    def put_topic(self, topic: str, rows: StructArray) -> None:
        """Store rows of a further topic of the robot (`hil.robot.HasTopics`)."""

    def event(self, kind: str, **details: Any) -> None:
        """Store one event."""


@dataclass(slots=True)
class Progress:
    """Counters of read samples and completed steps.

    Attributes:
        samples: Number of rows of the base record that were read.
        first, last: Device time of the first and the newest row [s].
        unsettled: Indices of the plan steps whose dwell ended by its time-out.
        steps_done: Number of plan steps that were completed.
    """

    samples: int = 0
    first: float = float("nan")
    last: float = float("nan")
    unsettled: list[int] = field(default_factory=list)
    steps_done: int = 0

    def count(self, block: StructArray) -> None:
        """Add the rows of a block to the counters."""
        if self.samples == 0:
            self.first = float(block["device_time"][0])
        self.samples += len(block)
        self.last = float(block["device_time"][-1])


class Reading:
    """Reader of the state of one robot for one run.

    Args:
        robot: Connected robot.
        sink: Receiver of all samples and events.
        interlocks: Interlocks that are checked on every sample.
        joint_names: Names of the joints, used in messages.
        obey_stop: Callback that raises an error if a stop was requested; called before every block.
        hold: Callback that receives every violation of an interlock with the action `pause`.
        on_block: Callback that receives every block of rows after the block was recorded and
            checked.
        stale_after_s: Maximum time without a new robot state [s]; None for the default of the
            interlock `stale`.

    Attributes:
        judge: Object that calls the interlocks.
        wall: Whether the robot uses a wall clock instead of a virtual clock.
        progress: Counters of samples and steps.
        newest: Newest state row of the run; None before the first row.
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
        """Return the next block of state rows after recording and checking the block.

        Raises:
            Stopped: A stop was requested.
            RobotError: The robot reports a fault.
            InterlockTripped: A sample violates an interlock, or no new sample has arrived for too
                long.
            RecordingError: The sink cannot store the samples.
        """
        self._obey_stop()
        if self._topics is not None and not self.progress.samples:
            self._topics.drain()  # discards rows read before the run
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
            # Stop immediately; the engine stops the robot again later and reports a failure.
            with contextlib.suppress(Exception):
                stop_robot(self._robot)
            raise trip.error(self._joint_names)
        self._on_block(block)
        return block

    def to_rest(self) -> str:
        """Record a stopped robot until it is static; return the problem, or an empty text."""
        deadline = self.deadline(REST_WITHIN_S)
        try:
            while True:
                block = self._robot.read()
                # A failed or slow recorder must not prevent the monitoring of the arm.
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
            return f"standstill of the arm was not confirmed: {error.message}"

    def deadline(self, seconds: float) -> Deadline:
        """Return a time-out object that starts now."""
        return Deadline(seconds, self.progress.last, wall=self.wall)

    def begin_leg(self) -> None:
        """Start a leg, which is the part of the plan from one checkpoint to the next.

        A leg counts as slowed from its start if the controller speed is already reduced at the
        start.
        """
        self._leg_slowed = is_slowed(self._scaling)

    @property
    def speed_share(self) -> float:
        """Present ratio of executed to planned speed, reported by the robot controller, 0 to 1."""
        return self._scaling if is_slowed(self._scaling) else 1.0

    @property
    def slowed(self) -> str:
        """Message about a reduced speed of the controller; empty if the robot moves as planned."""
        if not is_slowed(self._scaling):
            return ""
        return f"the robot's speed scaling (speed slider) is at {self._scaling:.0%}"

    @property
    def notes(self) -> list[str]:
        """Notes for the operator on the recorded data."""
        if not self._slowed_at:
            return []
        times = f"{len(self._slowed_at)} times, first" if len(self._slowed_at) > 1 else "once,"
        return [
            f"the robot's speed scaling (speed slider) was lowered {times} at device time "
            f"{self._slowed_at[0]:.3f} s; lowest value {self._lowest:.0%}. Measurements at reduced "
            "speed are excluded"
        ]

    def _mark_speed(self, block: StructArray) -> None:
        """Set the bit `SLOWED` in the rows of a leg with reduced controller speed."""
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
        """Return the error that ends the run for a block with a fault.

        The returned error is the error that the driver raises at the next read; if the driver
        raises no error, the returned error contains the fault code.
        """
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
"""Time that an interlock needs for one block above which the interlock is reported as slow [s],
because the robot has to wait."""

_T = TypeVar("_T")


class Judge:
    """Caller of all interlocks for a block of rows; names each interlock that fails or is slow.

    Args:
        interlocks: Interlocks in the order in which they are called.
        now: Monotonic clock [s].
    """

    def __init__(
        self, interlocks: Sequence[Interlock], now: Callable[[], float] = time.monotonic
    ) -> None:
        self._interlocks = tuple(interlocks)
        self._now = now
        self._asking: Interlock | None = None
        # The first block is checked before any motion, so slow checks are acceptable there.
        self._armed = False
        self._slow: dict[str, float] = {}

    def violations(self, block: StructArray) -> Iterator[tuple[Interlock, Trip]]:
        """Yield the interlocks that a block violates, each immediately after its check.

        Raises:
            InterlockTripped: An interlock raises an exception or returns an invalid value.
        """
        for interlock in self._interlocks:
            trip = self._call(interlock, interlock.check, block)
            if trip is not None and not isinstance(trip, Trip):
                raise _interlock_failure(interlock, f"check returned {trip!r}, which is not a Trip")
            if trip is not None:
                yield interlock, trip
        self._armed = True

    def clear(self, block: StructArray) -> bool:
        """Return whether a block is well within the limits of all pausing interlocks."""
        pausing = (i for i in self._interlocks if i.action == "pause")
        return all(self._call(interlock, interlock.clear, block) for interlock in pausing)

    @property
    def hanging(self) -> InterlockTripped | None:
        """Error that names the interlock being checked now, or None if there is none."""
        asking = self._asking
        return (
            _interlock_failure(asking, "its check did not return for several seconds")
            if asking
            else None
        )

    @property
    def notes(self) -> list[str]:
        """Messages about slow interlocks, for which the robot had to wait."""
        return [
            f"interlock {name} took up to {seconds:.2g} s for one block: its check must not wait"
            for name, seconds in self._slow.items()
        ]

    def _call(
        self, interlock: Interlock, ask: Callable[[StructArray], _T], block: StructArray
    ) -> _T:
        self._asking, begin = interlock, self._now()
        try:
            return ask(block)
        except HilError:
            raise
        except Exception as error:  # a plug-in can raise any exception
            raise _interlock_failure(
                interlock, f"{type(error).__name__}: {error}", error
            ) from error
        finally:
            self._asking, took = None, self._now() - begin
            if took > SLOW_S and self._armed:
                self._slow[interlock.name] = max(took, self._slow.get(interlock.name, 0.0))


def _interlock_failure(
    interlock: Interlock, why: str, error: Exception | None = None
) -> InterlockTripped:
    """Return the violation for an interlock that cannot check a block.

    A state that is not checked counts as unsafe.
    """
    where = ""
    if error is not None:
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        place = f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}" if trace else "its check"
        where = f", raised in {place}"
    return InterlockTripped(
        f"interlock {interlock.name}: {why}",
        hint=f"repair the interlock ({origin_of(interlock)}{where}), or remove it from the spec",
    )


STALE_AFTER_BLOCKS = 50
"""Maximum number of consecutive blocks without a newer sample, used for robots with a virtual
clock."""


class Freshness:
    """Interlock `stale`, which trips if the device clock does not advance.

    Args:
        after_s: Wall time without a newer sample after which the state counts as stale [s]; None
            for the default.
        wall: Whether the robot uses a wall clock; with a virtual clock, blocks are counted instead
            of wall time.
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
        """Check the device times of one block of rows.

        Raises:
            StaleState: The device time is not a finite number.
            InterlockTripped: The device time has not advanced for longer than the limit.
        """
        times = block["device_time"]
        if not np.isfinite(times).all():
            raise StaleState(
                "the device time of the robot is not a finite number",
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
        """Return a message about the time without new samples; empty within the limit."""
        if not self._wall:
            blocks = f"{self._blocks} blocks in a row without a newer sample"
            return blocks if self._blocks > STALE_AFTER_BLOCKS else ""
        quiet = self._now() - self._since
        limit = f"limit {self._after_s:g} s"
        return f"no newer sample for {quiet:.3g} s, {limit}" if quiet > self._after_s else ""

    def _how(self, time_s: float) -> str:
        if time_s < self._newest:
            return f"went backwards, from {self._newest:.3f} s to {time_s:.3f} s"
        return f"stands still at {self._newest:.3f} s"


STANDS_STILL_S = 0.5
"""Wall time without any progress of the device clock after which the device clock counts as
stopped [s]."""

LEAST_WALL_S = 1.0
"""Minimum wall time before a time-out [s], even if one second on a virtual clock lasts only 0.1
s."""


class Deadline:
    """Time-out measured with the device clock, or with the wall clock if the device clock stops.

    With a wall clock, the device clock alone does not cause a time-out before `LEAST_WALL_S`: a
    fast mock robot would otherwise time out whenever this process gets no processor time. The wall
    clock alone does not cause a time-out while the device time advances, because simulated drives
    on a busy computer are slower than planned.

    Args:
        seconds: Allowed time [s].
        begin: Present device time [s].
        wall: Whether the robot uses a wall clock; with a virtual clock, only device time counts.
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
        """Extend the time-out by `seconds`."""
        self.seconds += seconds
        self._device_end += seconds
        self._wall_end += seconds

    def over(self, device_time: float) -> bool:
        """Return whether the time-out has expired; a device time of NaN counts as expired."""
        now = self._now()
        if device_time > self._newest:
            self._newest, self._advanced = device_time, now
        if not device_time <= self._device_end:
            return now >= self._not_before
        return now > self._wall_end and now - self._advanced > STANDS_STILL_S
