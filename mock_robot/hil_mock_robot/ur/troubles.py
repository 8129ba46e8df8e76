"""Lets faults strike the controller, its line and its ports, and end again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hil_mock_robot.server.faults import Schedule
from hil_mock_robot.ur.contracts import Motion
from hil_mock_robot.ur.faults import KINDS, OWNERS, Fault, fault_of
from hil_mock_robot.ur.machine import Event, Machine
from hil_mock_robot.ur.motion import StopJoints, StopL
from hil_mock_robot.ur.rtde import Ownership
from hil_mock_robot.ur.wire import COUNTED, LASTING

DASHBOARD = 29999
STOPS = (StopJoints, StopL)


class Troubles:
    """What is wrong, tick by tick; `Loop` looks at the attributes.

    Args:
        machine: What suffers.
        faults: What is to happen.
        owners: Of RTDE's inputs.

    Attributes:
        unplugged: Nothing gets through on any port, in either direction.
        mute: Ports whose clients are neither heard nor answered.
        dark: The controller is being rebooted: nobody listens and no time passes for it.
        listeners: Told of each fault, and whether it begins.
    """

    def __init__(
        self, machine: Machine, faults: Sequence[Fault] = (), owners: Ownership | None = None
    ) -> None:
        self._machine, self._owners = machine, owners or Ownership()
        self._schedule = Schedule(faults, machine.tick_s)
        self._motion: Motion | None = None
        self.unplugged = self.dark = False
        self.mute: frozenset[int] = frozenset()
        self.listeners: list[Callable[[Fault, bool], None]] = []
        self._effects: dict[str, Callable[[Fault, bool], None]] = {
            "unplugged": self._unplug,
            "dashboard_hang": self._hang_dashboard,
            "reboot": self._reboot,
            "protective_stop": self._protective_stop,
            "emergency_stop": self._emergency_stop,
            "safeguard_stop": self._safeguard_stop,
            "safety_fault": self._safety_fault,
            "overheat": self._overheat,
            "inputs_owned": self._own_inputs,
            "remote_off": self._leave_remote,
            "payload_refused": self._refuse_payload,
        }
        machine.listeners.append(self._heard)

    @property
    def lasting(self) -> list[Fault]:
        """What has begun and is not over; a stop is a moment's matter, the modes tell of it."""
        return [fault for fault in self._schedule.lasting if "for_s" in KINDS[fault.kind]]

    def add(self, given: object) -> Fault:
        """One more fault, from the side channel; without a time it begins at once.

        Raises:
            SpecError: It is unknown or cannot be.
        """
        fault = fault_of("fault", given)
        if self._schedule.add(fault):
            self._strike(fault, begins=True)
        return fault

    def clear(self) -> None:
        """End what lasts and forget what was to come; a reboot still takes its time."""
        for fault in self._schedule.clear(keep="reboot"):
            self._strike(fault, begins=False)
        self._machine.line.mend()

    def tick(self) -> None:
        """What is due before the machine's next tick."""
        self._watch_motion()
        begun, over = self._schedule.turn()
        for fault in over:
            self._strike(fault, begins=False)
        for fault in begun:
            self._strike(fault, begins=True)
        self._machine.line.tick()

    def _watch_motion(self) -> None:
        motion = self._machine.motion
        if motion is not self._motion and motion is not None and not isinstance(motion, STOPS):
            self._schedule.began("motion")
        self._motion = motion

    def _heard(self, event: Event) -> None:
        if event.kind == "program_started":
            self._schedule.began("program")

    def _strike(self, fault: Fault, *, begins: bool) -> None:
        for listener in self.listeners:
            listener(fault, begins)
        if fault.only == OWNERS:
            self._cut_owners(begins)
        elif fault.kind in (*LASTING, *COUNTED, "cut"):
            line = self._machine.line
            (line.begin if begins else line.end)(fault)
        else:
            self._effects[fault.kind](fault, begins)

    def _cut_owners(self, begins: bool) -> None:
        if begins:
            for owner in self._owners.clients:
                owner.hang_up()

    def _unplug(self, fault: Fault, begins: bool) -> None:
        self.unplugged = begins

    def _hang_dashboard(self, fault: Fault, begins: bool) -> None:
        self.mute = frozenset({DASHBOARD}) if begins else frozenset()

    def _reboot(self, fault: Fault, begins: bool) -> None:
        self.dark = begins
        if begins:
            self._machine.cut_power()
        else:
            self._machine.boot(powered=fault.powered)

    def _protective_stop(self, fault: Fault, begins: bool) -> None:
        if begins:
            self._machine.protective_stop(fault.code)

    def _emergency_stop(self, fault: Fault, begins: bool) -> None:
        if begins:
            self._machine.emergency_stop()

    def _safeguard_stop(self, fault: Fault, begins: bool) -> None:
        """When it is over the program stays paused until somebody lets it go on."""
        if begins:
            self._machine.safeguard_stop()
        else:
            self._machine.modes.cause("end safeguard stop")

    def _safety_fault(self, fault: Fault, begins: bool) -> None:
        if begins:
            self._machine.fault()

    def _overheat(self, fault: Fault, begins: bool) -> None:
        if begins:
            self._machine.body.heat(fault.joint - 1, fault.celsius)

    def _own_inputs(self, fault: Fault, begins: bool) -> None:
        if not begins:
            self._owners.release(self)
            return
        for name in self._machine.inputs.variables:
            if self._owners.free(name, self):
                self._owners.take([name], self)

    def _leave_remote(self, fault: Fault, begins: bool) -> None:
        self._machine.modes.remote = not begins

    def _refuse_payload(self, fault: Fault, begins: bool) -> None:
        self._machine.body.deaf = begins
