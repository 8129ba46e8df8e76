"""Drives and the arm between them: what a frame, a SYNC and time do to them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hil.arms import Payload
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import joints_of
from hil_mock_robot.cia402.body import Body
from hil_mock_robot.cia402.clock import DeviceClock
from hil_mock_robot.cia402.contracts import Send
from hil_mock_robot.cia402.dictionary import registers_of
from hil_mock_robot.cia402.marker import Marker
from hil_mock_robot.cia402.nmt import State
from hil_mock_robot.cia402.objects import real
from hil_mock_robot.cia402.routes import Routes, changed_by
from hil_mock_robot.cia402.siblings import Siblings
from hil_mock_robot.cia402.unit import PERIOD, Unit

SYNC = 0x080
DEFAULT_PERIOD_S = 0.004
MOUNT_STEPS = 20
"""Device time after the last write to a payload object before the load hangs at the flange: it is
written in parts, and each change of the plant costs a few milliseconds."""

TICK_STEPS = 5
"""How often heartbeats, event timers and the watch on the master are looked at, in device time."""

PAYLOAD = (keys.PAYLOAD_MASS, keys.PAYLOAD_X, keys.PAYLOAD_Y, keys.PAYLOAD_Z)

Event = Callable[[str, dict[str, int | float | str]], None]


class Station:
    """All axes of one arm on one bus; one thread, no socket, no clock of its own.

    Args:
        body: The arm.
        nodes: Node id of each axis.
        put: Puts a frame on the bus.
        clock: Device time.
        master_id: Node id under which the master announces what it does.
        mounted: What really hangs at the flange; what is declared when None.
        flush: Lets the bus have what was put on it, before the arm is moved.

    Attributes:
        axes: The drives.
        body, clock: As given.
        marker: What the master has announced.
        declared: The load that was written into the payload objects.
        listeners: Told of what happens: a word, and what belongs to it.
        passed: Called after each block of steps, with their number.
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
        """Power on."""
        for axis in self.axes:
            axis.node.boot()

    def heard(self, can_id: int, data: bytes, now_s: float) -> None:
        """A frame is on the bus; nobody's here sent it."""
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
        """Wall time has passed: the drives' own timer, where SYNC stays away."""
        was_synced = self.clock.synced
        steps = self.clock.own(now_s)
        if was_synced and not self.clock.synced:
            self.tell("sync_lost")
        if steps:
            self._advance(steps, synced=False)
            self._release()
        self._siblings.listen(self._routes)

    def mount(self, payload: Payload | None) -> None:
        """Hang something to the flange, whatever is declared; None for what is declared."""
        self._mounted = payload
        self.body.mount(self.mounted)

    @property
    def mounted(self) -> Payload:
        """What really hangs at the flange."""
        return self.declared if self._mounted is None else self._mounted

    def tell(self, event: str, **details: int | float | str) -> None:
        """Let all who listen know."""
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
        self._flush()  # the master reads the answers while the arm moves on
        if steps:
            self._advance(steps, synced=True)

    def _release(self) -> None:
        """The drives' time has come to where the wall's is: what is late may be due."""
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
        if state == State.OPERATIONAL:
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
        """Time has one pace: that of the first drive that was told one, best an operational one."""
        ordered = sorted(self.axes, key=lambda axis: not axis.operational)
        told = (axis.drive.period_s for axis in ordered)
        self._period_s = next((period for period in told if period), DEFAULT_PERIOD_S)

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
