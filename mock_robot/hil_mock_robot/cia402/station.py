"""Mock station: all drives of one arm on one bus, together with the simulated arm.

`Station` applies frames, SYNCs and time to the drives and the arm. `Station` is used by one thread,
and has no socket and no clock. `Unit` is one drive with its node and its line to the bus.
`DeviceClock` counts device time, which SYNC advances; the caller passes wall time. `Routes` and
`Siblings` deliver each frame to the drives that receive this frame. `Marker` and `MotionWatch`
detect the beginning and end of a motion.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from hil.arms import Payload
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.access_rules import COB_ID
from hil_mock_robot.cia402.axis import Joint, joints_of
from hil_mock_robot.cia402.body import STEP_S, Body
from hil_mock_robot.cia402.bus import Line, Send
from hil_mock_robot.cia402.dictionary import N_PDOS, NOT_VALID, RPDO_PARAMETERS, real, registers_of
from hil_mock_robot.cia402.drive import Drive
from hil_mock_robot.cia402.keys import Registers, key
from hil_mock_robot.cia402.node import RESET_NODE, Hooks, MockNode, NmtState
from hil_mock_robot.cia402.power import State

SYNC = 0x080
DEFAULT_PERIOD_S = 0.004

MOUNT_STEPS = 20
"""Number of steps from the last write of a payload object to the change of the payload.

A payload is written in parts, and each change of the simulated arm takes a few milliseconds. The
delay joins the parts to one change.
"""

TICK_STEPS = 5
"""Period of the checks of heartbeats, event timers and the master, in steps of device time."""

PAYLOAD = (keys.PAYLOAD_MASS, keys.PAYLOAD_X, keys.PAYLOAD_Y, keys.PAYLOAD_Z)
Event = Callable[[str, dict[str, int | float | str]], None]
PERIOD = (keys.INTERPOLATION_VALUE, keys.INTERPOLATION_INDEX, keys.CYCLE_PERIOD)


class Station:
    """All axes of one arm on one bus, used by one thread, without socket and clock.

    Args:
        body: Simulated arm.
        nodes: Node id of each axis.
        put: Function that puts a frame on the bus.
        clock: Clock of device time.
        master_id: Node id of the master's marker.
        mounted: True payload at the flange; None for the payload that the master declares.
        flush: Function that sends queued frames before the arm is moved.

    Attributes:
        axes: Drives of the arm.
        body: Simulated arm.
        clock: Clock of device time.
        marker: Last marker frame of the master.
        declared: Payload that was written into the payload objects.
        listeners: Callbacks for events, called with the name and the details of an event.
        passed: Callbacks that are called after each block of steps, with the number of steps.
    """

    def __init__(
        self,
        body: Body,
        nodes: Sequence[int],
        put: Send,
        clock: DeviceClock,
        master_id: int = 127,
        mounted: Payload | None = None,
        flush: Callable[[], None] = lambda: None,
    ) -> None:
        self.body, self.clock, self._flush = body, clock, flush
        self.listeners: list[Event] = []
        self.passed: list[Callable[[int], None]] = []
        self.marker = Marker(master_id)
        self.declared, self._mounted = Payload(), mounted
        self._siblings = Siblings(put)
        self.axes = tuple(self._unit(i, node) for i, node in enumerate(nodes))
        self._routes = Routes(self.axes)
        self._operational: set[int] = set()
        self._tick_due = 0
        self._mount_due: int | None = None
        self._period_s = DEFAULT_PERIOD_S
        for axis, seen in zip(self.axes, body.seen, strict=True):
            axis.drive.measured(seen)

    def _unit(self, number: int, node_id: int) -> Unit:
        arm = self.body.arm
        registers, joint = registers_of(arm, number), joints_of(arm)[number]
        voice = self._siblings.voice(number)
        return Unit(number, node_id, registers, joint, voice, self._told, self._written)

    def boot(self) -> None:
        """Switch all drives on."""
        for axis in self.axes:
            axis.node.boot()

    def heard(self, can_id: int, data: bytes, now_s: float) -> None:
        """Handle a received frame, which must not come from a drive of this station."""
        if can_id == SYNC:
            self._synced(now_s)
        else:
            if can_id == self.marker.can_id:
                self.marker.heard(data)
            for axis in self._routes.to(can_id):
                if axis.line.sound or axis.line.passes(can_id, data):
                    axis.node.heard(can_id, data)
        self._siblings.listen(self._routes)

    def lapsed(self, now_s: float) -> None:
        """Advance wall time; without SYNC the drives are advanced by their own timer."""
        was_synced = self.clock.synced
        steps = self.clock.own(now_s)
        if was_synced and not self.clock.synced:
            self.tell("sync_lost")
        if steps:
            self._advance(steps, synced=False)
            self._release()
        self._siblings.listen(self._routes)

    def mount(self, payload: Payload | None) -> None:
        """Mount a payload, whatever the master declares; None for the declared payload."""
        self._mounted = payload
        self.body.mount(self.mounted)

    @property
    def mounted(self) -> Payload:
        """True payload at the flange."""
        return self.declared if self._mounted is None else self._mounted

    def tell(self, event: str, **details: int | float | str) -> None:
        """Pass an event to all listeners."""
        for listener in self.listeners:
            listener(event, details)

    def _synced(self, now_s: float) -> None:
        if not self.clock.synced:
            self.tell("sync", period_s=self._period_s)
        self._release()
        steps = self.clock.sync(now_s, self._period_s)
        for axis in self.axes:
            if axis.synced:
                axis.node.synced()
        self._flush()  # the master reads the answers during the next steps of the arm
        if steps:
            self._advance(steps, synced=True)

    def _release(self) -> None:
        """Send delayed frames that are due at the present device time."""
        for axis in self.axes:
            if not axis.line.sound:
                axis.line.release()

    def _advance(self, steps: int, *, synced: bool) -> None:
        axes = self.axes
        demands = [
            axis.drive.advance(steps, synced=synced and axis.synced, missed=axis.node.missed)
            for axis in axes
        ]
        for axis, measured in zip(axes, self.body.advance(demands), strict=True):
            axis.drive.measured(measured, steps)
            if not axis.line.sound:
                axis.line.passed(steps)
        if self.clock.steps >= self._tick_due:
            self._tick()
        if self._mount_due is not None and self.clock.steps >= self._mount_due:
            self._mount_declared()
        if self.body.faults:
            for number, code in self.body.faults.items():
                axes[number].drive.fault(code)
        for listener in self.passed:
            listener(steps)

    def _tick(self) -> None:
        self._tick_due = self.clock.steps + TICK_STEPS
        for axis in self.axes:
            axis.node.ticked(self.clock.device_s)

    def _told(self, axis: int, what: str, code: int) -> None:
        if what == "booted":
            self._routes.forget()
        if what == "nmt":
            self._now_in(axis, code)
        if what in ("booted", "nmt"):
            self._look_at_period()
        self.tell(what, axis=axis + 1, code=code)

    def _now_in(self, axis: int, state: int) -> None:
        if state == NmtState.OPERATIONAL:
            self._operational.add(axis)
        elif axis in self._operational:
            self._operational.remove(axis)
            if not self._operational:
                self.clock.idle()

    def _written(self, axis: int, key: int) -> None:
        if changed_by(key):
            self._routes.forget()
        if key in PERIOD:
            self._look_at_period()
        if axis == 0 and key in PAYLOAD:
            self._declare()

    def _look_at_period(self) -> None:
        """Use the SYNC period that a drive has set, preferably an operational drive."""
        ordered = sorted(self.axes, key=lambda axis: not axis.operational)
        periods = (axis.drive.period_s for axis in ordered)
        self._period_s = next((period for period in periods if period), DEFAULT_PERIOD_S)

    def _declare(self) -> None:
        values = [real(self.axes[0].registers[key]) for key in PAYLOAD]
        if not np.isfinite(values).all():
            return
        mass, x, y, z = values
        self.declared = Payload(max(0.0, mass), (x, y, z))
        self._mount_due = self.clock.steps + MOUNT_STEPS

    def _mount_declared(self) -> None:
        self._mount_due = None
        if self.mounted != self.body.mounted:
            self.body.mount(self.mounted)


Told = Callable[[int, str, int], None]
"""Callback for an event of a drive, with axis (from 0), event name and code.

The possible event names are `emergency`, `nmt`, `booted` and `connection_lost`.
"""

NMT = 0x000


class Unit:
    """Drive with its node and its line to the bus.

    Args:
        number: Number of the axis, from 0.
        node_id: Node id on the bus.
        registers: Live objects, with the values after power-on.
        joint: Properties of the joint.
        put: Function that puts a frame on the bus.
        told: Callback for events of the drive.
        written: Callback with axis and key of every object that a client has written.

    Attributes:
        number: Number of the axis, from 0.
        node_id: Node id on the bus.
        registers: Live objects of the drive.
        line: Connection of the drive to the bus.
        node: CANopen node.
        drive: Mock drive of the axis.
        follows_sync: Whether the drive reacts to SYNC.
    """

    def __init__(
        self,
        number: int,
        node_id: int,
        registers: Registers,
        joint: Joint,
        put: Send,
        told: Told,
        written: Callable[[int, int], None],
    ) -> None:
        self.number, self.node_id, self.registers = number, node_id, registers
        self.follows_sync = True
        self._operational = False
        self._told, self._on_written = told, written
        self.line = Line(node_id, put)
        hooks = Hooks(
            applied=lambda: self.drive.obey(),
            written=self._written,
            resetting=lambda _: self.drive.connection.taken_off(),
            nmt_changed=self._nmt_changed,
            booted=self._booted,
            connection_lost=self._connection_lost,
        )
        self.node = MockNode(node_id, registers, self.line.send, hooks)
        self.drive = Drive(registers, joint, self._emergency)

    @property
    def operational(self) -> bool:
        """Whether the drive exchanges process data."""
        return self._operational

    @property
    def synced(self) -> bool:
        """Whether SYNC reaches the drive."""
        return self.follows_sync and not self.line.cuts

    def bus_off(self) -> None:
        """Simulate bus-off of the drive's CAN controller."""
        self.line.cuts.add("bus_off")
        self.line.look()
        self.node.bus_off()

    def recover(self) -> None:
        """Put the drive back on the bus."""
        if "bus_off" in self.line.cuts:
            self.line.cuts.discard("bus_off")
            self.line.look()
            self.node.bus_back()

    def power_off(self) -> None:
        """Switch the supply of the drive off; the brake closes."""
        self.line.cuts.add("power")
        self.line.look()
        self.drive.reset()

    def power_on(self) -> None:
        """Switch the supply of the drive on; its settings are lost."""
        self.line.cuts.discard("power")
        self.line.look()
        self.node.heard(NMT, bytes([RESET_NODE, self.node_id]))

    def _written(self, key: int, value: int) -> None:
        self.drive.written(key)
        if key == keys.SIMULATED_ERROR:
            self.drive.fault(value)
        self._on_written(self.number, key)

    def _nmt_changed(self, state: int) -> None:
        left, self._operational = self._operational, state == NmtState.OPERATIONAL
        self._told(self.number, "nmt", state)
        if left or state == NmtState.STOPPED:
            self.drive.connection.taken_off()

    def _booted(self, application: bool) -> None:
        self._operational = False
        if application:
            self.drive.restart()
        self._told(self.number, "booted", int(application))

    def _connection_lost(self, code: int) -> None:
        self._told(self.number, "connection_lost", code)
        self.drive.connection.lost(code)

    def _emergency(self, code: int, register: int) -> None:
        self._told(self.number, "emergency", code)
        self.node.emergency(code, register)


PROCESS_DATA = range(0x181, 0x580)
SDO = 0x600
SDO_REQUESTS = range(SDO + 1, SDO + 0x80)
CAN_ID = 0x7FF


class Routes:
    """Cache of the drives that receive each identifier, valid until a COB-ID changes.

    Args:
        units: All drives.
    """

    def __init__(self, units: Sequence[Unit]) -> None:
        self._units = tuple(units)
        self._known: dict[int, tuple[Unit, ...]] = {}

    def to(self, can_id: int) -> tuple[Unit, ...]:
        """Return the drives that receive frames of this identifier."""
        found = self._known.get(can_id)
        if found is None:
            found = self._known[can_id] = self._look(can_id)
        return found

    def forget(self) -> None:
        """Clear the cache after a change of PDO parameters."""
        self._known.clear()

    def _look(self, can_id: int) -> tuple[Unit, ...]:
        if can_id in PROCESS_DATA:
            return tuple(unit for unit in self._units if can_id in _received(unit))
        if can_id in SDO_REQUESTS:
            return tuple(unit for unit in self._units if SDO + unit.node_id == can_id)
        return self._units


def _received(unit: Unit) -> set[int]:
    cob_ids = (unit.registers[key(RPDO_PARAMETERS + i, COB_ID)] for i in range(N_PDOS))
    return {cob_id & CAN_ID for cob_id in cob_ids if not cob_id & NOT_VALID}


def changed_by(where: int) -> bool:
    """Return whether a write of the object with this key changes the receivers of frames."""
    return RPDO_PARAMETERS <= where >> 8 < RPDO_PARAMETERS + N_PDOS


HEARTBEATS = range(0x701, 0x780)


class Siblings:
    """Delivery of frames from drive to drive, after all drives have handled the last frame.

    Args:
        put: Function that sends a frame on the bus.
    """

    def __init__(self, put: Send) -> None:
        self._put = put
        self._said: deque[tuple[int, int, bytes]] = deque()

    def voice(self, number: int) -> Send:
        """Return the function by which the drive with a number (from 0) sends frames."""

        def say(can_id: int, data: bytes) -> None:
            self._put(can_id, data)
            if can_id in PROCESS_DATA or can_id in HEARTBEATS:
                self._said.append((number, can_id, data))

        return say

    def listen(self, routes: Routes) -> None:
        """Deliver frames to the other drives: linked PDOs, monitored heartbeats."""
        while self._said:
            number, can_id, data = self._said.popleft()
            for unit in routes.to(can_id):
                if unit.number != number and unit.line.passes(can_id, data):
                    unit.node.heard(can_id, data)


PATIENCE_S = 0.2
"""Wall time without SYNC before the drives use their own timer [s].

During the wait device time stands still, so that pauses of a master on a busy computer have no
effect on the drives.
"""

IDLE_PATIENCE_S = 0.02
"""Wall time without SYNC before the drives use their own timer, if no drive is operational [s]."""

PERIODS_MISSED = 2.0

CARRIED = 1e-9
"""Tolerance of rounding errors in sums of periods, in steps."""

LONGEST_STALL_S = 0.1
"""Longest wall time that the drives' own timer makes up for in one call [s]."""


class DeviceClock:
    """Clock of device time, in steps of `STEP_S`.

    Each SYNC advances device time by one period, whatever the wall time, because a master can be
    faster or slower than real time. Without SYNC, device time advances with wall time.

    Args:
        now_s: Wall time, monotonic [s].
        patience_s: Wall time without SYNC after which the drives use their own timer; at least two
            periods [s].

    Attributes:
        steps: Number of steps since the start.
        synced: Whether SYNC advances device time.
        syncs: Number of SYNCs since the start.
    """

    def __init__(self, now_s: float, patience_s: float = PATIENCE_S) -> None:
        self._patience_s = patience_s
        self.steps = self.syncs = 0
        self.synced = False
        self._rest = 0.0
        self._gives_up_s = self._synced_s = now_s
        self._own_s = now_s

    @property
    def device_s(self) -> float:
        """Device time [s]."""
        return self.steps * STEP_S

    def sync(self, now_s: float, period_s: float) -> int:
        """Handle a SYNC; return the number of steps that it advances.

        Args:
            now_s: Wall time [s].
            period_s: Configured period of the drives between two SYNCs [s].
        """
        self.synced = True
        self.syncs += 1
        self._synced_s = now_s
        self._gives_up_s = now_s + max(PERIODS_MISSED * period_s, self._patience_s)
        return self._pass(period_s)

    def own(self, now_s: float) -> int:
        """Advance wall time without a SYNC; return the steps by which the own timer advances."""
        if self.synced:
            if now_s < self._gives_up_s:
                return 0
            # The silence so far is not caught up, because the SYNC was possibly only delayed.
            self.synced, self._own_s = False, self._gives_up_s
        self._own_s = max(self._own_s, now_s - LONGEST_STALL_S)
        steps = int((now_s - self._own_s) / STEP_S + CARRIED)
        self._own_s += steps * STEP_S
        self.steps += steps
        return steps

    def idle(self) -> None:
        """Shorten the wait for SYNC when no drive is operational any more."""
        self._gives_up_s = min(self._gives_up_s, self._synced_s + IDLE_PATIENCE_S)

    def slept(self, lasted_s: float) -> None:
        """Extend the wait for SYNC by a time [s] in which the mock could not receive frames."""
        self._gives_up_s += lasted_s

    def wait_s(self, now_s: float, steps: int) -> float:
        """Return the wall time until the own timer is due for `steps` steps [s]; 0 if overdue."""
        due = self._gives_up_s if self.synced else self._own_s
        return max(0.0, due + steps * STEP_S - now_s)

    def _pass(self, period_s: float) -> int:
        self._rest += period_s / STEP_S
        steps = int(self._rest + CARRIED)
        self._rest -= steps
        self.steps += steps
        return steps


FRAME = struct.Struct("<iH")
"""Layout of the marker: step of the plan (int32) and status (uint16)."""

TPDO1 = 0x180

MOVING = 1
"""Bit of the marker's status that is set while the motion of the step is running."""


class Marker:
    """Marker with the segment and the status that the master announces.

    Args:
        master_id: Node id of the master.

    Attributes:
        can_id: Identifier of the marker frame.
        known: Whether a marker was received.
        segment: Last announced step of the plan.
        status: Last announced status.
    """

    def __init__(self, master_id: int) -> None:
        self.can_id = TPDO1 + master_id
        self.known = False
        self.segment, self.status = -1, 0

    @property
    def moving(self) -> bool:
        """Whether a motion is running."""
        return bool(self.status & MOVING)

    def heard(self, data: bytes) -> None:
        """Handle a frame with the marker's identifier; frames of a different length are ignored."""
        if len(data) == FRAME.size:
            self.segment, self.status = FRAME.unpack(data)
            self.known = True


STANDSTILL_S = 0.1
"""Device time without a set-point change after which a change begins a new motion [s]."""

SETPOINTS = (keys.TARGET_POSITION, keys.TARGET_VELOCITY, keys.TARGET_TORQUE)


class MotionWatch:
    """Detector of the beginning and end of a motion.

    The marker of the master determines the motion. If the master sends no marker, changing
    set-points count as a motion.

    Args:
        station: Station to observe; `passed` must be called after every block of steps.

    Attributes:
        moving: Whether a motion is running.
        listeners: Callbacks with True at the beginning and False at the end of a motion.
    """

    def __init__(self, station: Station) -> None:
        self._station = station
        self._setpoints: list[int] = []
        self._still_steps = 0
        self.moving = False
        self.listeners: list[Callable[[bool], None]] = []

    def passed(self, steps: int) -> None:
        """Update the state after a number of steps."""
        marker = self._station.marker
        moving = marker.moving if marker.known else self._changing(steps)
        if moving is not self.moving:
            self.moving = moving
            for listener in self.listeners:
                listener(moving)

    def _changing(self, steps: int) -> bool:
        now = [
            axis.registers[key]
            for axis in self._station.axes
            if axis.drive.state is State.OPERATION_ENABLED
            for key in SETPOINTS
        ]
        changed = len(now) == len(self._setpoints) and now != self._setpoints
        self._setpoints = now
        self._still_steps = 0 if changed else self._still_steps + steps
        if not now:
            return False
        return changed or (self.moving and self._still_steps * STEP_S < STANDSTILL_S)
