"""A UR arm as `hil` drives it: rows by a reader of our own, motion by `ur-rtde` in its own process.

The constructor of `ur-rtde` can hold the interpreter for ever, and the library connects again by
itself; so it lives in a process that may be killed (`motion`). This process reads every row of the
controller (`controller`, `rtde`), so recordings have no gaps whatever the other one does.

`UrRobot` puts the two together. `Watch` knows how the arm stands: from what it was told to do, the
controller's rows, and what the process that moves it says. It decides when a motion is over, what
is a fault, and whether a stop had its effect. `Standing` notes when each segment began and ended,
by device time, and stamps rows with that.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hil.arms import Payload
from hil.core import (
    CommandRefused,
    HilError,
    RobotConnectionError,
    RobotFault,
    RobotTimeout,
    StaleState,
    StructArray,
)
from hil.robot import (
    Address,
    Capabilities,
    Finding,
    Identity,
    Limits,
    Segment,
    Status,
    Topic,
    is_loopback,
)
from hil_drivers.arm import faulty, not_connected, nothing_prepared, require_liftable
from hil_drivers.ur.controller import KEPT_S, READ_BACK_S, Controller, reached
from hil_drivers.ur.dashboard import stop_directly, stop_program
from hil_drivers.ur.motion import MotionProcess
from hil_drivers.ur.options import Options, capabilities_of, options_of, require_playable
from hil_drivers.ur.state import (
    PAUSED,
    PAUSING,
    TOPIC,
    complaints,
    first_fault,
    further_rows,
    further_topic,
    program_running,
    program_state,
    slider_of,
    state_rows,
    still,
)


class UrRobot:
    """A robot (`hil.robot.Robot`) for arms of Universal Robots.

    Args:
        name: The robot's name in its station.
        model: A built-in arm: ur3, ur5, ur10, or these with an e.
        options: See `hil_drivers.ur.options.Options`.

    Raises:
        SpecError: An option is missing, unknown, or cannot be.
    """

    def __init__(self, name: str, model: str, **options: Any) -> None:
        self._name, self._model, self._given = name, model, options
        self._options = options_of(options, model)
        self._controller = Controller(model, self._options)
        self._motion = MotionProcess(name, model, options)
        self._topic = further_topic(self.capabilities.rate_hz)
        self._further: list[StructArray] = []
        self._watch = Watch(self._options)
        self._declared: Payload | None = None
        self._connected = self._listening = False
        self._prepared: Segment | None = None
        self._stops = 0
        self._newest: StructArray | None = None
        self._slider = math.nan

    @property
    def resource(self) -> str:
        """See `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """See `hil.robot.HasAddress`."""
        return Address(self._options.address, real=not is_loopback(self._options.address))

    @property
    def identity(self) -> Identity:
        """See `hil.robot.Robot`."""
        self._require_connection()
        return self._controller.identity

    @property
    def capabilities(self) -> Capabilities:
        """See `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """See `hil.robot.Robot`; once connected, none is wider than the controller's own."""
        return self._controller.limits

    @property
    def topics(self) -> Sequence[Topic]:
        """See `hil.robot.HasTopics`."""
        return (self._topic,)

    @property
    def speed_scaling(self) -> float:
        """See `hil.robot.HasSpeedScaling`: the speed slider of the teach pendant."""
        return self._slider

    def drain(self) -> Mapping[str, StructArray]:
        """See `hil.robot.HasTopics`."""
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def checks(self) -> Sequence[Finding]:
        """See `hil.robot.HasChecks`."""
        self._require_health()
        motion, asked = self._motion, self._controller.findings
        return list(asked(self._declared, moved_by_us=lambda: motion.alive))

    def reach(self) -> Sequence[Finding]:
        """See `hil.robot.HasReach`."""
        return list(reached(self._options.address))

    def connect(self) -> None:
        """Listen, look whether the arm may be moved, upload the program that moves it.

        After a fault or a lost connection it does so from the beginning.

        Raises:
            RobotConnectionError: No controller answers, it has another arm, or is in use.
            RobotFault: The arm is not in a state in which it may move, or a program plays.
        """
        alive = self._controller.receiver.alive and self._motion.alive
        if self._connected and alive and not (self._watch.faulty or self._watch.severed):
            return
        self._let_go()
        try:
            self._controller.open()
            given = self._given | {"address": self._controller.host}
            self._motion = MotionProcess(self._name, self._model, given)
            self._motion.connect()
            self._controller.forget_rows()
        except BaseException:
            self._let_go()
            raise
        self._watch, self._further, self._declared = Watch(self._options), [], None
        self._connected = True

    def listen(self) -> None:
        """Connect for receiving state only; see `hil.robot.Listens`.

        Raises:
            RobotConnectionError: No controller answers, or it has another arm.
            SpecError: It does not send what shall be the effort.
        """
        if self._listening and self._controller.receiver.alive:
            return
        self._let_go()
        try:
            self._controller.listen()
        except BaseException:
            self._let_go()
            raise
        self._listening, self._further, self._newest = True, [], None

    @property
    def program_running(self) -> bool:
        """See `hil.robot.Listens`."""
        return self._newest is not None and bool(program_running(self._newest[-1:])[0])

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a load and wait until the controller reports it.

        Raises:
            CommandRefused: It is too heavy, the arm is moving, or it was not accepted.
        """
        self._require_health()
        require_liftable(payload, self.limits)
        self._motion.set_payload(payload)
        self._declared = payload
        until = time.monotonic() + READ_BACK_S
        while not payload.agrees_with(self._controller.believed) and time.monotonic() < until:
            time.sleep(0.005)
        return self._controller.believed

    def prepare(self, segment: Segment) -> None:
        """Check and keep the next segment.

        Raises:
            CommandRefused: It leaves the limits, moves at its ends, or begins elsewhere.
            RobotFault: The arm does not obey any more.
        """
        self._require_health()
        stops = self._stops
        require_playable(segment, self.limits, self._controller.row["target_q"])
        if segment.kind != "hold":
            self._motion.prepare(segment)
        self._prepared = segment
        if self._stops != stops:  # one that has come meanwhile holds
            self._prepared = None
            raise CommandRefused("stopped while it was prepared", hint="prepare it again")

    def start(self) -> None:
        """Begin the prepared segment.

        Raises:
            CommandRefused: Nothing is prepared, or a motion is still on.
        """
        segment, self._prepared = self._prepared, None
        self._require_health()
        if segment is None:
            raise nothing_prepared()
        if self._watch.moving:
            raise CommandRefused("a segment is still running", hint="read until it is over")
        self._controller.receiver.keep(None)  # a dwell is measured as much as a motion
        if segment.kind == "hold":
            # What waits to be read was before it, and may be seconds old.
            now = float(self._controller.row["timestamp"])
            self._watch.begun(segment.index, now, moves=False)
            return
        self._watch.begun(segment.index, self._motion.start(), moves=True)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """All samples since the last call.

        A fault comes with the rows that show it; the next call raises it, once, so that whoever
        watches the arm come to rest still sees it.

        Raises:
            RobotTimeout: No sample arrived in time.
            RobotFault: The arm stopped, or was stopped because it did not follow.
            RobotConnectionError: The controller or the process that moves it is gone.
        """
        self._require_connection()
        problem, self._watch.problem = self._watch.problem, None
        if problem is not None:
            raise problem
        raw = self._controller.receiver.take(timeout_s)
        # From here on nothing is raised: what was taken is in nobody else's hands.
        self._newest = raw
        self._slider = slider_of(raw)
        rows = state_rows(raw, self._options.torque_source)
        self._further.append(further_rows(raw, self._topic))
        if self._listening:
            return rows
        self._look(raw)
        self._watch.stamp(rows)
        return rows

    def stop(self) -> None:
        """Bring the arm to rest: by the program that moves it, else by one that replaces it.

        Seconds after our program was ended by somebody else, their programs are left alone.

        Raises:
            RobotConnectionError: No way to stop the arm was open.
        """
        if not self._connected:
            return
        self._stops += 1
        self._prepared = None
        newest = self._controller.receiver.newest
        row = None if newest is None else newest[0]
        if self._watch.is_for_others(row):
            return
        self._watch.stopping(row)
        try:
            self._motion.stop()
        except HilError as error:
            self._watch.severed |= isinstance(error, RobotTimeout)
            self._stop_directly()
        else:
            if self._watch.must_not_go_on(row):
                # A program that a protective stop has paused must not go on once it is unlocked.
                stop_program(self._controller.host)

    def close(self) -> None:
        """Stop, end the program, disconnect."""
        if self._listening:
            self._let_go()
        if not self._connected:
            return
        try:
            self.stop()
        except RobotConnectionError:
            return
        finally:
            self._let_go()

    def _look(self, raw: StructArray) -> None:
        """Update the state of the motion; the next read raises a problem."""
        progress, error = None, None
        try:
            progress = None if self._watch.severed else self._motion.look()[0]
        except HilError as caught:
            error = caught
        ended = self._watch.look(raw, progress, error, left=self._motion.left)
        if self._watch.stop_has_failed(raw):
            self._watch.severed = True
            try:
                self._stop_directly()
            except RobotConnectionError as caught:
                self._watch.note(caught)
            stop_program(self._controller.host)
        if self._watch.halted and not self._watch.moving:
            self._controller.receiver.keep(KEPT_S)
        elif ended:
            self._controller.receiver.keep(None, forgiving=True)

    def _stop_directly(self) -> None:
        self._watch.replaced = True
        if not stop_directly(self._controller.host, self._options.stop_rad_s2):
            raise RobotConnectionError(
                f"{self._options.address}: the controller could not be told to stop; its watchdog "
                f"stops the program within {1 / self._options.watchdog_hz:.2f} s",
                hint="see to the robot itself, by its emergency stop if need be",
            )

    def _require_connection(self) -> None:
        if not (self._connected or self._listening):
            raise not_connected(self._name)

    def _require_health(self) -> None:
        self._require_connection()
        if self._listening:
            raise CommandRefused(f"{self._name} is only listened to", hint="call connect() first")
        if self._watch.severed:
            raise RobotFault(
                f"{self._name} was stopped by a program that has replaced the one that moves it",
                hint="connect() again",
            )
        if self._watch.faulty:
            raise faulty(self._name)

    def _let_go(self) -> None:
        self._connected = self._listening = False
        self._prepared = self._newest = None
        self._motion.close()
        self._controller.close()


RAMP_GRACE_S = 0.5
"""How much longer than its ramp an arm may take to be seen standing still after a stop [s]."""

EXPLAINED_S = 0.5
"""How long it waits for rows that explain it when the process that moves the arm has stopped the
arm and left: it sees them by a connection of its own [s]."""

OURS_FOR_S = 3.0
"""How long after the end of our program a fault is still ours to deal with [s]; whoever stands at
the pendant may start another one then."""


class Watch:
    """State of the arm, from connecting to the first fault.

    Args:
        options: Of the arm.

    Attributes:
        faulty: Whether it does not obey any more: it has to be connected again.
        halted: Whether the arm was stopped since the newest segment began.
        replaced: Whether our program was ended by ourselves, and is not to be missed.
        severed: Whether the process that moves the arm was passed over when the arm was stopped:
            its program is gone without its doing, and it ends.
        gone_at: Device time at which our program was seen to have ended; None while it was not [s].
        problem: What was found wrong; the next read raises it, once.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._standing = Standing()
        self._stopped_by: float | None = None
        self._left: tuple[float, HilError] | None = None
        self.faulty = self.halted = self.replaced = self.severed = False
        self.gone_at: float | None = None
        self.problem: HilError | None = None

    @property
    def moving(self) -> bool:
        """Whether the newest segment's motion has not been seen to end."""
        return self._standing.moving

    def begun(self, index: int, at: float, *, moves: bool) -> None:
        """A segment begins after that device time [s]."""
        self._standing.begin(index, at, moves=moves)
        self.halted = False
        if moves:
            self._stopped_by = None

    def stopping(self, row: Any) -> None:
        """Note that the arm is stopped; with its newest raw row, None if there is none."""
        self.halted = True
        if row is not None:
            speed = float(np.abs(row["target_qd"]).max())
            ramp_s = speed / self._options.stop_rad_s2 + RAMP_GRACE_S
            self._stopped_by = float(row["timestamp"]) + ramp_s

    def look(
        self,
        raw: StructArray,
        progress: np.void | None,
        error: HilError | None,
        *,
        left: bool = False,
    ) -> bool:
        """Judge a block of raw rows, every one of them.

        Args:
            raw: (N,), N ≥ 1.
            progress: How the motion stands, by the process that moves the arm.
            error: What that process said instead.
            left: Whether it has stopped the arm and ended by itself.

        Returns:
            Whether a motion has just been seen to end.
        """
        moved = self.moving
        if moved and progress is not None and not int(progress["status"]) & Status.MOVING:
            self._standing.end(float(progress["device_time"]))
        ended = ~program_running(raw)
        if self.gone_at is None and ended.any():
            self.gone_at = float(raw["timestamp"][int(ended.argmax())])
        if error is not None:
            self._left = self._left or (float(raw["timestamp"][-1]), error)
        # Who has stopped the arm for silence has ended the program, too: that explains nothing.
        stale = self._left is not None and isinstance(self._left[1], StaleState)
        fault = first_fault(raw, program=not (self.replaced or stale))
        if fault is None and error is not None and self._left is not None:
            since, error = self._left
            waits = left and float(raw["timestamp"][-1]) - since < EXPLAINED_S
            error = None if waits else error
        self.note(fault or error)
        if self.moving and self.halted and progress is None and still(raw[-1]):
            # Who moved it is not there any more to say so. While it is, the arm may stand before
            # the program has answered the stop, and nothing can be started before that.
            self._standing.end(float(raw["timestamp"][-1]))
        return moved and not self.moving

    def note(self, problem: HilError | None) -> None:
        """Note a problem; the first one counts."""
        if problem is not None and not self.faulty:
            self.problem, self.faulty, self.halted = problem, True, True

    def must_not_go_on(self, row: Any) -> bool:
        """Return whether a raw row shows a pause of our program that a person could end."""
        if row is None or not self.faulty or self.gone_at is not None:
            return False
        # For some ticks after a protective stop the program may still be said to play.
        held = int(program_state(row.reshape(1))[0]) in (PAUSING, PAUSED) or complaints(row)
        return bool(held)

    def is_for_others(self, row: Any) -> bool:
        """Return whether another client moves the arm.

        Shortly after our program has ended it may be that `ur-rtde` has uploaded it again.
        """
        if row is None or not self.faulty or self.gone_at is None:
            return False
        return float(row["timestamp"]) - self.gone_at > OURS_FOR_S

    def stop_has_failed(self, raw: StructArray) -> bool:
        """Return, once, whether the arm moved when it ought to have been at rest.

        What it does later is another's doing.
        """
        if self._stopped_by is None:
            return False
        after = raw[raw["timestamp"] >= self._stopped_by]
        if not len(after):
            return False
        self._stopped_by = None
        return not still(after[0])

    def stamp(self, rows: StructArray) -> None:
        """Fill in segment and status of state rows, in place."""
        self._standing.stamp(rows)
        if self.faulty:
            rows["status"][-1] |= Status.FAULT


class Standing:
    """Beginning and end of each segment, by device time.

    Segments follow each other: one ends where the next begins. A motion that nobody has seen end
    yet is still going on.
    """

    def __init__(self) -> None:
        # When it began, its index, when its motion was over (inf: not yet).
        self._known: list[tuple[float, int, float]] = [(-np.inf, -1, -np.inf)]

    @property
    def moving(self) -> bool:
        """Whether the newest segment's motion has not been seen to end."""
        return self._known[-1][2] == np.inf

    def begin(self, index: int, at: float, *, moves: bool) -> None:
        """A segment begins with the first sample after a device time [s]."""
        self.end(at)
        self._known.append((at, index, np.inf if moves else at))

    def end(self, at: float) -> None:
        """The newest motion was over by that device time; nothing happens when none was on."""
        begun, index, _ = self._known[-1]
        if self.moving:
            self._known[-1] = (begun, index, max(at, begun))

    def stamp(self, rows: StructArray) -> None:
        """Fill `segment` and the bits `MOVING` or `HOLDING` of `status`, in place."""
        times = rows["device_time"]
        moving = np.zeros(len(rows), dtype=bool)
        for begun, index, over in self._known:
            mine = times > begun
            rows["segment"][mine] = index
            moving = np.where(mine, times <= over, moving)
        rows["status"] |= np.where(moving, Status.MOVING, Status.HOLDING).astype("<i4")
        while len(self._known) > 1 and self._known[1][0] < times[0]:
            self._known.pop(0)
