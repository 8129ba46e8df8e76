"""Driver of a UR arm: an RTDE client receives rows, a separate process moves the arm by `ur-rtde`.

The constructor of `ur-rtde` can block the interpreter forever, and the library reconnects by
itself. `ur-rtde` therefore runs in a separate process that can be killed (module `motion`). The
process of the driver receives every row of the controller (modules `controller` and `rtde`), so
recordings have no gaps even if the motion process fails.

`UrRobot` combines both. `Watch` tracks the state of the arm from the commands, the controller's
rows and the reports of the motion process. `Watch` decides when a motion is over, which conditions
are faults, and whether a stop was effective. `Standing` records the device times at which each
segment begins and ends, and writes segment and status into rows.
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
    """Robot driver (`hil.robot.Robot`) for arms of Universal Robots.

    Args:
        name: Name of the robot in its station.
        model: Built-in arm: ur3, ur5, ur10, ur3e, ur5e or ur10e.
        options: Options of the arm; see `hil_drivers.ur.options.Options`.

    Raises:
        SpecError: An option is missing, unknown or invalid.
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
        """Resource name of the arm; see `hil.robot.HasResource`."""
        return self._options.resource

    @property
    def address(self) -> Address:
        """Address of the controller; see `hil.robot.HasAddress`."""
        return Address(self._options.address, real=not is_loopback(self._options.address))

    @property
    def identity(self) -> Identity:
        """Model, serial number and software of the connected arm; see `hil.robot.Robot`."""
        self._require_connection()
        return self._controller.identity

    @property
    def capabilities(self) -> Capabilities:
        """Names, rate and effort kind of the arm; see `hil.robot.Robot`."""
        return capabilities_of(self._model, self._options)

    @property
    def limits(self) -> Limits:
        """Joint limits of the arm; after `connect`, no wider than the limits of the controller."""
        return self._controller.limits

    @property
    def topics(self) -> Sequence[Topic]:
        """Topic of the RTDE outputs beyond the base record; see `hil.robot.HasTopics`."""
        return (self._topic,)

    @property
    def speed_scaling(self) -> float:
        """Position of the speed slider of the teach pendant; see `hil.robot.HasSpeedScaling`."""
        return self._slider

    def drain(self) -> Mapping[str, StructArray]:
        """Return the rows of the topic of `topics` since the last call.

        The method belongs to the ability `hil.robot.HasTopics`.
        """
        further, self._further = self._further, []
        return {TOPIC: np.concatenate(further)} if further else {}

    def checks(self) -> Sequence[Finding]:
        """Return the preflight findings of the driver; see `hil.robot.HasChecks`."""
        self._require_health()
        motion, asked = self._motion, self._controller.findings
        return list(asked(self._declared, moved_by_us=lambda: motion.alive))

    def reach(self) -> Sequence[Finding]:
        """Return findings about the network ports of the controller; see `hil.robot.HasReach`."""
        return list(reached(self._options.address))

    def connect(self) -> None:
        """Connect to the controller, check that the arm can be moved, and upload the robot program.

        After a fault or a lost connection, the whole connection is established again.

        Raises:
            RobotConnectionError: No controller answers, the controller moves a different arm, or
                another client uses the controller.
            RobotFault: The state of the arm does not permit a motion, or a program plays.
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
        """Connect to receive the state of the controller only; see `hil.robot.Listens`.

        Raises:
            RobotConnectionError: No controller answers, or the controller moves a different arm.
            SpecError: The controller does not send the RTDE output of the configured torque source.
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
        """Whether a program plays or is paused on the controller; see `hil.robot.Listens`."""
        return self._newest is not None and bool(program_running(self._newest[-1:])[0])

    def set_payload(self, payload: Payload) -> Payload:
        """Declare a payload and wait until the controller reports it.

        Returns:
            Payload that the controller reports, returned at the latest after `READ_BACK_S`.

        Raises:
            CommandRefused: The payload is too heavy, the arm is moving, or the controller refused
                it.
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
        """Check and store the next segment.

        Raises:
            CommandRefused: The segment exceeds the limits, is not at rest at its ends, or does not
                begin at the present set-point.
            RobotFault: The arm has a fault and does not obey any more.
        """
        self._require_health()
        stops = self._stops
        require_playable(segment, self.limits, self._controller.row["target_q"])
        if segment.kind != "hold":
            self._motion.prepare(segment)
        self._prepared = segment
        if self._stops != stops:  # a concurrent stop has priority
            self._prepared = None
            raise CommandRefused(
                "the segment was stopped while it was prepared", hint="prepare it again"
            )

    def start(self) -> None:
        """Start the prepared segment.

        Raises:
            CommandRefused: No segment is prepared, or a motion is still running.
        """
        segment, self._prepared = self._prepared, None
        self._require_health()
        if segment is None:
            raise nothing_prepared()
        if self._watch.moving:
            raise CommandRefused("a segment is still running", hint="read until the segment ends")
        self._controller.receiver.keep(None)  # a dwell is recorded like a motion
        if segment.kind == "hold":
            # Queued rows are older than the start, possibly by seconds.
            now = float(self._controller.row["timestamp"])
            self._watch.begun(segment.index, now, moves=False)
            return
        self._watch.begun(segment.index, self._motion.start(), moves=True)

    def read(self, timeout_s: float = 1.0) -> StructArray:
        """Return all samples since the last call.

        A fault is raised by exactly one call: the call after the one that returned the rows with
        the fault. A client that watches the arm come to rest therefore receives the rows that show
        the fault.

        Raises:
            RobotTimeout: No sample arrived in time.
            RobotFault: The arm stopped because of a fault, or the driver stopped the arm because it
                did not follow its set-points.
            RobotConnectionError: The connection to the controller or the motion process is lost.
        """
        self._require_connection()
        problem, self._watch.problem = self._watch.problem, None
        if problem is not None:
            raise problem
        raw = self._controller.receiver.take(timeout_s)
        # Nothing below raises: an exception would lose the rows taken from the receiver.
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
        """Stop the arm by the robot program, or by a second program that replaces the first.

        If the driver's program ended more than `OURS_FOR_S` seconds ago, the program of another
        client is left running.

        Raises:
            RobotConnectionError: No stop command could be sent.
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
                # A program paused by a protective stop must not resume when the stop is unlocked.
                stop_program(self._controller.host)

    def close(self) -> None:
        """Stop the arm, end the robot program and disconnect."""
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
        """Update the state of the motion from raw rows; the next `read` raises any problem."""
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
                f"{self._options.address}: no stop could be sent to the controller; its watchdog "
                f"stops the program within {1 / self._options.watchdog_hz:.2f} s",
                hint="press the emergency stop if the arm moves",
            )

    def _require_connection(self) -> None:
        if not (self._connected or self._listening):
            raise not_connected(self._name)

    def _require_health(self) -> None:
        self._require_connection()
        if self._listening:
            raise CommandRefused(
                f"{self._name} is connected for listening only", hint="call connect() first"
            )
        if self._watch.severed:
            raise RobotFault(
                f"{self._name} was stopped by a program that has replaced its motion program",
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
"""Device time [s] after the end of the stop ramp within which the rows must show the arm at
rest."""

EXPLAINED_S = 0.5
"""Device time [s] of the wait for rows that show the cause after the motion process has stopped
the arm and exited; these rows arrive by a separate connection."""

OURS_FOR_S = 3.0
"""Device time [s] after the end of the driver's program during which the driver still stops the
arm; later, an operator at the pendant has possibly started a different program."""


class Watch:
    """State of the arm from the connection to the first fault.

    Args:
        options: Options of the arm.

    Attributes:
        faulty: Whether the arm has a fault, so that it must be connected again.
        halted: Whether a stop was requested since the newest segment began.
        replaced: Whether the driver itself has replaced the robot program, so that the end of the
            program does not count as a fault.
        severed: Whether the arm was stopped without the motion process, which then loses its robot
            program and exits.
        gone_at: Device time of the first row without the robot program [s]; None before such a row.
        problem: Detected problem, which only the next call of `read` raises.
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
        """Whether the motion of the newest segment has not ended yet."""
        return self._standing.moving

    def begun(self, index: int, at: float, *, moves: bool) -> None:
        """Record the device time [s] after which a new segment begins."""
        self._standing.begin(index, at, moves=moves)
        self.halted = False
        if moves:
            self._stopped_by = None

    def stopping(self, row: Any) -> None:
        """Record a stop request and set its time limit.

        Args:
            row: Newest raw row; None if there is no row, in which case no time limit is set.
        """
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
        """Check every row in a block of raw rows for faults and for the end of the robot program.

        Args:
            raw: (N,) raw rows, N ≥ 1.
            progress: State of the motion reported by the motion process.
            error: Error that the motion process raised instead of reporting `progress`.
            left: Whether the motion process has stopped the arm and exited by itself.

        Returns:
            Whether a motion has ended in this block.
        """
        moved = self.moving
        if moved and progress is not None and not int(progress["status"]) & Status.MOVING:
            self._standing.end(float(progress["device_time"]))
        ended = ~program_running(raw)
        if self.gone_at is None and ended.any():
            self.gone_at = float(raw["timestamp"][int(ended.argmax())])
        if error is not None:
            self._left = self._left or (float(raw["timestamp"][-1]), error)
        # After a stop for silence, the end of the program is a consequence, not the cause.
        stale = self._left is not None and isinstance(self._left[1], StaleState)
        fault = first_fault(raw, program=not (self.replaced or stale))
        if fault is None and error is not None and self._left is not None:
            since, error = self._left
            waits = left and float(raw["timestamp"][-1]) - since < EXPLAINED_S
            error = None if waits else error
        self.note(fault or error)
        if self.moving and self.halted and progress is None and still(raw[-1]):
            # The motion process is gone and cannot report the end. While it runs, the arm is
            # possibly at rest before the program confirms the stop, and no motion can start before
            # that.
            self._standing.end(float(raw["timestamp"][-1]))
        return moved and not self.moving

    def note(self, problem: HilError | None) -> None:
        """Record a problem; only the first problem is retained."""
        if problem is not None and not self.faulty:
            self.problem, self.faulty, self.halted = problem, True, True

    def must_not_go_on(self, row: Any) -> bool:
        """Return whether a raw row shows that an operator could resume the driver's program."""
        if row is None or not self.faulty or self.gone_at is not None:
            return False
        # For some ticks after a protective stop, the program is possibly still reported as
        # playing.
        held = int(program_state(row.reshape(1))[0]) in (PAUSING, PAUSED) or complaints(row)
        return bool(held)

    def is_for_others(self, row: Any) -> bool:
        """Return whether another client is possibly moving the arm, from the newest raw row.

        Within `OURS_FOR_S` after the end of the driver's program, a running program is assumed to
        be an upload by `ur-rtde`.
        """
        if row is None or not self.faulty or self.gone_at is None:
            return False
        return float(row["timestamp"]) - self.gone_at > OURS_FOR_S

    def stop_has_failed(self, raw: StructArray) -> bool:
        """Return whether the arm moves after the time limit of a stop; true at most once per stop.

        A motion that begins later belongs to another client and is not checked.
        """
        if self._stopped_by is None:
            return False
        after = raw[raw["timestamp"] >= self._stopped_by]
        if not len(after):
            return False
        self._stopped_by = None
        return not still(after[0])

    def stamp(self, rows: StructArray) -> None:
        """Write segment and status into state rows, in place."""
        self._standing.stamp(rows)
        if self.faulty:
            rows["status"][-1] |= Status.FAULT


class Standing:
    """Record of the device times at which each segment starts and ends.

    A segment ends when the next segment begins. A motion continues until its end is detected.
    """

    def __init__(self) -> None:
        # Device time of the start, index, device time of the end of motion (inf: not yet).
        self._known: list[tuple[float, int, float]] = [(-np.inf, -1, -np.inf)]

    @property
    def moving(self) -> bool:
        """Whether the motion of the newest segment has not ended yet."""
        return self._known[-1][2] == np.inf

    def begin(self, index: int, at: float, *, moves: bool) -> None:
        """Record that a segment begins with the first sample after a device time [s]."""
        self.end(at)
        self._known.append((at, index, np.inf if moves else at))

    def end(self, at: float) -> None:
        """Record the device time [s] at which the newest motion ended, if it is still running."""
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
