"""Reading the robot: every block is recorded first and judged second."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from hil.core import HilError, RecordingError, RobotFault, StructArray, bounded
from hil.engine.freshness import Deadline, Freshness
from hil.engine.interlocks import Interlock, Trip, is_slowed
from hil.engine.judging import Judge
from hil.engine.requests import Requests
from hil.robot import HasSpeedScaling, HasTopics, Robot, Status

REST_RAD_S = 0.01
"""All joints slower than this, and no motion commanded, is at rest."""

STOP_WITHIN_S = 2.0
"""A driver whose `stop` takes longer hangs; the contract allows 0.1 s."""

REST_WITHIN_S = 5.0
"""An arm that still moves this long after it was stopped is reported as not at rest [s]."""


NEWS_SHARE = 0.05
"""A speed scaling that has changed by so much more is another event of the log."""


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
        requests: Looked at before every block.
        stale_after_s: How long the state may stand still [s]; None for the default.
        told: Called with every block after it was recorded and judged.
        patience: Told how long a call that is about to be made may take [s].
    """

    def __init__(
        self,
        robot: Robot,
        sink: Sink,
        interlocks: Sequence[Interlock],
        joint_names: Sequence[str],
        requests: Requests,
        *,
        stale_after_s: float | None = None,
        told: Callable[[StructArray], object] = lambda block: None,
        patience: Callable[[float], object] = lambda seconds: None,
    ) -> None:
        self._robot = robot
        self._topics = robot if isinstance(robot, HasTopics) else None
        self._scaled = robot if isinstance(robot, HasSpeedScaling) else None
        self._scaling = self._lowest = 1.0
        self._slowed_at: list[float] = []
        self._leg_slowed = False
        self._sink = sink
        self.judge = Judge(interlocks)
        self._joint_names = tuple(joint_names)
        self._told = told
        self.patience = patience
        self.wall = robot.capabilities.clock == "wall"
        self._freshness = Freshness(stale_after_s, wall=self.wall)
        self.requests = requests
        self.progress = Progress()
        self.newest: np.void | None = None

    def block(self) -> StructArray:
        """The next block, recorded and judged.

        Raises:
            Stopped: A stop was requested.
            RobotError: The robot reports a fault.
            InterlockTripped: A sample violates an interlock, or none is new for too long.
            RecordingError: The sink cannot keep the data.
        """
        self.requests.obey_stop()
        block = self._recorded()
        self._freshness.check(block)
        if (block["status"] & Status.FAULT).any():
            raise self._fault(block)
        for interlock, trip in self.judge.violations(block):
            self._obey(interlock, trip)
        self._told(block)
        return block

    def _obey(self, interlock: Interlock, trip: Trip) -> None:
        if interlock.action == "pause":
            # The first violation is the reason; those that follow only go on with it.
            self.requests.held = self.requests.held or trip.text(self._joint_names)
            return
        # At once; the engine stops it again on the way out and says if that does not work.
        with contextlib.suppress(Exception):
            bounded(self._robot.stop, STOP_WITHIN_S, "stopping the robot")
        raise trip.error(self._joint_names)

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

    def deadline(self, seconds: float) -> Deadline:
        """A time-out that begins now."""
        return Deadline(seconds, self.progress.last, wall=self.wall)

    def to_rest(self) -> str:
        """Record a stopped robot until it is at rest; says what is wrong, or nothing."""
        deadline = self.deadline(REST_WITHIN_S)
        try:
            while True:
                block = self._kept_if_possible()
                if _at_rest(block):
                    return ""
                self._freshness.check(block)
                if deadline.over(self.progress.last):
                    return f"the arm was not at rest {REST_WITHIN_S:g} s after it was stopped"
        except HilError as error:
            return f"nobody saw the arm come to rest: {error.message}"

    def _kept_if_possible(self) -> StructArray:
        """A block; a recorder that is dead or behind does not keep us from watching the arm."""
        block = self._robot.read()
        with contextlib.suppress(RecordingError):
            self._mark_speed(block)
            self._keep(block)
        self.progress.count(block)
        return block

    def _recorded(self) -> StructArray:
        if self._topics is not None and not self.progress.samples:
            self._topics.drain()  # belongs to what was read before the run
        block = self._robot.read()
        self._mark_speed(block)
        self._keep(block)
        self.progress.count(block)
        self.newest = block[-1]
        return block

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
        """The driver's own words if the next read brings them, else the code."""
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


def _at_rest(block: StructArray) -> bool:
    row = block[-1]
    moving = bool(row["status"] & Status.MOVING)
    return not moving and bool((np.abs(row["qd"]) < REST_RAD_S).all())
